"""One synthetic scene's disparities against the exact truth."""

from pathlib import Path

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.labels_against_truth import MadeScene, evaluate_truth

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    made = (snakemake.input[key] for key in ("disparity", "truth", "tiles"))
    with rule_job(snakemake, f"evaluate {scene}"):
        evaluate_truth(
            scene,
            [MadeScene(scene, *map(Path, made))],
            snakemake.output.figures,
            snakemake.output.table,
            workers=snakemake.threads,
            provenance={"code": snakemake.params.code},
        )
