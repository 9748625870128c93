"""The alignment of one pair by the corrections of its images."""

from pathlib import Path

from stereotruth.align.records import ScenePair, pair_alignment, read_site
from stereotruth.core.products.files import write_sealed
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums, describe, digest

if __name__ == "__main__":
    scene, given = snakemake.wildcards.scene, snakemake.input
    with rule_job(snakemake, f"adjusted alignment {scene}"):
        site = read_site(given.site)
        pair = ScenePair(
            scene, *snakemake.params.images, Path(given.alignment), Path(given.equations)
        )
        values = pair_alignment(site, pair)
        # Not of the whole site's figures: what other images change leaves the alignment as it is.
        inputs = checksums([given.alignment, given.equations])
        inputs |= {name: digest(site["images"][name]) for name in pair.names}
        values["provenance"] = describe(inputs, {}, snakemake.params.code)
        write_sealed(values, snakemake.output[0])
