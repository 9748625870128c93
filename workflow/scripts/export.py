"""One city's scenes to its benchmark tiles."""

import json
from pathlib import Path

from stereotruth.dataset.export import export_city
from stereotruth.dataset.scene_stores import SceneFiles
from stereotruth.dataset.settings import Settings
from stereotruth.dataset.summary import summary_lines
from stereotruth.job import job
from stereotruth.products.files import replacing
from stereotruth.products.publication import publication

if __name__ == "__main__":
    given, city = snakemake.input, snakemake.params.city
    of_right = list(given.disparity_of_right) or [None] * len(given.disparity)
    with (
        job(snakemake.log[0], f"export {city['city']}") as log,
        publication(snakemake.input, snakemake.output, snakemake.params),
    ):
        summary = export_city(
            scenes=list(
                map(
                    SceneFiles,
                    snakemake.params.scenes,
                    given.disparity,
                    given.left,
                    given.right,
                    given.alignment,
                    of_right,
                )
            ),
            out_dir=snakemake.output.tiles,
            **city,
            settings=Settings(**snakemake.params.settings),
            code=snakemake.params.code,
            workers=snakemake.threads,
            coverage=snakemake.output.coverage,
            contact_sheet=snakemake.output.contact_sheet,
            matches=snakemake.output.matches,
            ground_looks=snakemake.output.ground_looks,
            work=Path(snakemake.output.summary).with_name(".tiles.work"),
        )
        summary["lines"] = summary_lines(summary, snakemake.output.tiles)
        with replacing(snakemake.output.summary) as scratch:
            scratch.write_text(json.dumps(summary, indent=2) + "\n")
        for line in summary["lines"]:
            log.info(line)
