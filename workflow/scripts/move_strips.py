"""The points of one LiDAR file, moved by what their strips are off."""

from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.core.products.provenance import checksums, describe, digest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.strips import RECORD, StripOffsets, move_strips

if __name__ == "__main__":
    points, strips = snakemake.input.points, snakemake.input.strips
    with (
        job(snakemake.log[0], f"move_strips {snakemake.wildcards.scene}"),
        making(snakemake.input, snakemake.output),
    ):
        made_of = {"points": digest(PointStore(points).attrs.get("provenance", {}))}
        made_of |= checksums([f"{strips}/{RECORD}"])
        move_strips(
            points,
            StripOffsets.read(strips),
            snakemake.output.store,
            describe(made_of, {}, snakemake.params.code),
        )
