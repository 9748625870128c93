"""A scene's surface model against its LiDAR."""

from stereotruth.evaluation.surface_models.page import write_verdict
from stereotruth.evaluation.surface_models.reference import LidarReference
from stereotruth.evaluation.surface_models.score import score_surface_model
from stereotruth.job import job
from stereotruth.pages.page import INDEX
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.report.index_page import write_index

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    with (
        job(snakemake.log[0], f"score_dsm {scene} {method}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        verdict = score_surface_model(snakemake.input.dsm, LidarReference(snakemake.input.points))
        write_verdict(verdict, snakemake.output[0], f"{scene} by {method}", index=INDEX)
        write_index()
