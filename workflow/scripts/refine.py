"""What is left between one scene's LiDAR and its two images, taken out of the alignment."""

from pathlib import Path

from stereotruth.alignment import Alignment
from stereotruth.points import PointStore
from stereotruth.provenance import describe, digest, file_sha256
from stereotruth.refinement import refine
from stereotruth.refinement_report import write_refinement
from stereotruth.runlog import job

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    with job(snakemake.log[0], f"refine {scene}"):
        files = [*snakemake.input.left, *snakemake.input.right, snakemake.input.alignment]
        inputs = {Path(file).name: file_sha256(file) for file in files}
        for store in map(PointStore, snakemake.input.points):
            inputs[f"points/{store.path.name}"] = digest(store.attrs.get("provenance", {}))
        alignment, observations = refine(
            Alignment.load(snakemake.input.alignment),
            snakemake.input.left[0],
            snakemake.input.right[0],
            snakemake.input.points,
            strict=snakemake.params.strict,
            provenance=describe(inputs, {}, snakemake.params.code),
        )
        write_refinement(
            alignment,
            observations,
            snakemake.output.alignment,
            snakemake.output.observations,
            snakemake.output.figure,
        )
