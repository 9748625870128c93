"""What the labels of three pairs of a site's images say of each other."""

from pathlib import Path

from stereotruth.core.products.files import write_sealed
from stereotruth.core.products.grids import require_complete
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import describe, digest, file_sha256
from stereotruth.evaluate.closure import PairFiles, closure

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    with rule_job(snakemake, f"closure {city}"):
        pairs, inputs = [], {}
        files = zip(given.disparity, given.alignments, given.equations)
        for (scene, images), paths in zip(snakemake.params.pairs.items(), files):
            pair = PairFiles(scene, *images, *map(Path, paths))
            record = require_complete(pair.disparity).attrs.get("provenance", {})
            inputs |= {
                f"{scene}.zarr": digest(record),
                f"{scene}/alignment.json": file_sha256(pair.alignment),
                f"{scene}/equations.json": file_sha256(pair.equations),
            }
            pairs.append(pair)
        values = closure(city, pairs, describe(inputs, {}, snakemake.params.code))
        write_sealed(values, snakemake.output[0])
