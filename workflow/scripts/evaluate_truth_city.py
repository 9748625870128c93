"""A synthetic city's disparities, all scenes together, against the exact truth."""

from pathlib import Path

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.labels_against_truth import MadeScene, evaluate_truth

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    with rule_job(snakemake, f"evaluate {city}"):
        evaluate_truth(
            city,
            [
                MadeScene(scene, Path(disparity), Path(truth), Path(given.tiles))
                for scene, disparity, truth in zip(
                    snakemake.params.scenes, given.disparity, given.truth
                )
            ],
            snakemake.output.figures,
            snakemake.output.table,
            workers=snakemake.threads,
            provenance={"code": snakemake.params.code},
        )
