"""A scene's surface model against its LiDAR."""

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.evaluate.surface_models.reference import LidarReference
from stereotruth.evaluate.surface_models.score import score_surface_model, write_verdict
from stereotruth.pages.page import INDEX

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    with rule_job(snakemake, f"score_dsm {scene} {method}"):
        verdict = score_surface_model(snakemake.input.dsm, LidarReference(snakemake.input.points))
        write_verdict(verdict, snakemake.output[0], f"{scene} by {method}", index=INDEX)
        write_index()
