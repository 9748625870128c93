"""One city's scenes to its benchmark tiles."""

import json
from dataclasses import asdict
from pathlib import Path

from stereotruth.align.alignment import Alignment
from stereotruth.core.config.configuration import Export
from stereotruth.core.products.files import atomic_file, read_json
from stereotruth.core.products.making import rule_job
from stereotruth.tiles.export import Extras, export_city
from stereotruth.tiles.label_moves import edit_lines, keep_samples, since_last_run
from stereotruth.tiles.manifest import read_manifest
from stereotruth.tiles.scene_stores import SceneFiles
from stereotruth.tiles.tile_checks import misfit_lines, summary_lines
from stereotruth.tiles.tile_files import City

if __name__ == "__main__":
    given, city = snakemake.input, snakemake.params.city
    of_right = list(given.disparity_of_right) or [None] * len(given.disparity)
    with rule_job(snakemake, f"export {city['city']}") as log:
        scenes = map(
            SceneFiles,
            snakemake.params.scenes,
            given.disparity,
            given.left,
            given.right,
            given.alignment,
            of_right,
            snakemake.params.acquired,
            map(Alignment.read, given.alignment),
        )
        made = snakemake.output
        summary = export_city(
            City(**city),
            scenes,
            made.tiles,
            Export(**snakemake.params.settings),
            extras=Extras(made.coverage, made.contact_sheet, made.matches, made.ground_looks),
            code=snakemake.params.code,
            workers=snakemake.threads,
            work=Path(made.summary).with_name(".tiles.work"),
        )
        stores = dict(zip(snakemake.params.scenes, given.disparity))
        moved = since_last_run(stores)
        *lines, look = summary_lines(summary, snakemake.output.tiles)
        lines += misfit_lines(read_manifest(snakemake.output.tiles))
        summary["lines"] = [*lines, *edit_lines(moved, map(read_json, given.alignment)), look]
        summary["since_last_run"] = {scene: asdict(found) for scene, found in moved.items()}
        with atomic_file(snakemake.output.summary) as scratch:
            scratch.write_text(json.dumps(summary, indent=2) + "\n")
        for line in summary["lines"]:
            log.info(line)
        keep_samples(stores)
