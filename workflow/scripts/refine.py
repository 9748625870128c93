"""What is left between one scene's LiDAR and its two images, taken out of the alignment."""

from stereotruth.align.alignment import Alignment
from stereotruth.align.records import write_equations
from stereotruth.align.refine import refine, write_refinement
from stereotruth.core.config.configuration import Rectify
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums, describe, digest
from stereotruth.lidar.point_store import PointStore

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    with rule_job(snakemake, f"refine {scene}"):
        given = snakemake.input
        masks = given.left_mask, given.right_mask
        inputs = checksums([*given.left, *given.right, given.alignment], *masks)
        for store in map(PointStore, given.points):
            inputs[f"points/{store.path.name}"] = digest(store.attrs.get("provenance", {}))
        alignment, observations = refine(
            Alignment.read(given.alignment),
            given.left[0],
            given.right[0],
            given.points,
            masks=masks,
            bands=Rectify(**snakemake.params.bands),
            strict=snakemake.params.strict,
            alone=snakemake.params.alone,
            provenance=describe(inputs, {}, snakemake.params.code),
        )
        write_refinement(
            alignment,
            observations,
            snakemake.output.alignment,
            snakemake.output.observations,
        )
        write_equations(
            snakemake.output.equations,
            observations.of_images if observations else None,
            alignment.refinement["reason"],
        )
