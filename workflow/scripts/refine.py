"""What is left between one scene's LiDAR and its two images, taken out of the alignment."""

from pathlib import Path

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.refine import refine
from stereotruth.alignment.refine_report import write_refinement
from stereotruth.job import job
from stereotruth.lidar.point_store import PointStore
from stereotruth.products.provenance import describe, digest, file_sha256
from stereotruth.products.publication import publication

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    with (
        job(snakemake.log[0], f"refine {scene}"),
        publication(snakemake.input, snakemake.output, snakemake.params.made),
    ):
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
