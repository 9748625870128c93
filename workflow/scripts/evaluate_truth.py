"""Disparities of a synthetic scene, or of all scenes of a city, against the exact truth."""

from pathlib import Path

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.labels_against_truth import MadeScene, evaluate_truth

if __name__ == "__main__":
    given, scenes = snakemake.input, snakemake.params.scenes
    of = snakemake.wildcards.get("scene", snakemake.wildcards.city)
    disparity, truth = (
        [one] if isinstance(one, str) else one for one in (given.disparity, given.truth)
    )
    with rule_job(snakemake, f"evaluate {of}"):
        evaluate_truth(
            of,
            [
                MadeScene(scene, *map(Path, (labels, exact, given.tiles)))
                for scene, labels, exact in zip(scenes, disparity, truth)
            ],
            snakemake.output.figures,
            snakemake.output.table,
            workers=snakemake.threads,
            provenance={"code": snakemake.params.code},
        )
