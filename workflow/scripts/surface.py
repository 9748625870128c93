"""The points of a site to their surface for all images that show it, or to a strip of it."""

from stereotruth.core.products.grids import Strip
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.pair_geometry import GroundOfImages
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell

if __name__ == "__main__":
    scene, images = snakemake.wildcards.scene, sorted(set(snakemake.input.images))
    strip, made = Strip.of_wildcards(snakemake.wildcards), snakemake.output
    with rule_job(snakemake, f"surface {scene} {strip or ''}".strip()):
        ground = GroundOfImages.open(images)
        make_surface(
            open_stores(sorted(snakemake.input.points)),
            snakemake.params.store if strip else made.surface,
            cell=ground_cell(ground.pixel_deg),
            ground=ground,
            workers=snakemake.threads,
            made_of=checksums(images),
            code=snakemake.params.code,
            strip=strip,
        )
        if strip:
            strip.tell(made.done)
