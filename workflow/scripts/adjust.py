"""The images of a city whose pairs share images, corrected together."""

from pathlib import Path

from stereotruth.align.records import ScenePair
from stereotruth.align.site_adjustment import adjust_site
from stereotruth.core.products.files import write_sealed
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums, describe, file_sha256
from stereotruth.lidar.frames import Epoch

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    with rule_job(snakemake, f"adjust {city}"):
        pairs = [
            ScenePair(scene, left, right, Path(alignment), Path(equations), gcps or None)
            for (scene, (left, right, gcps)), alignment, equations in zip(
                snakemake.params.pairs.items(), given.alignments, given.equations
            )
        ]
        inputs = checksums([*given.gcps, *given.fixed])
        for pair in pairs:
            inputs[f"{pair.scene}/alignment.json"] = file_sha256(pair.alignment)
            inputs[f"{pair.scene}/equations.json"] = file_sha256(pair.equations)
        values = adjust_site(
            city,
            pairs,
            fixed=snakemake.params.fixed,
            strict=snakemake.params.strict,
            epoch=Epoch(*snakemake.params.epoch),
            provenance=describe(
                inputs, {"epoch": list(snakemake.params.epoch)}, snakemake.params.code
            ),
        )
        write_sealed(values, snakemake.output[0])
