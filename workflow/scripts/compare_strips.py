"""What the strips of a site's LiDAR are off, by their overlaps."""

import logging
from dataclasses import replace

from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import describe, digest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.strip_comparison import compare_strips

if __name__ == "__main__":
    with rule_job(snakemake, f"compare_strips {snakemake.wildcards.scene}"):
        stores = [PointStore(path) for path in snakemake.input.points]
        found = replace(compare_strips(stores), taken_out=snakemake.params.taken_out)
        if found.sentence:
            logging.getLogger("stereotruth").warning("warning: %s", found.sentence)
        made_of = {f"points/{s.path.name}": digest(s.attrs.get("provenance", {})) for s in stores}
        found.write(
            snakemake.output.strips,
            describe(made_of, {"taken_out": found.taken_out}, snakemake.params.code),
        )
