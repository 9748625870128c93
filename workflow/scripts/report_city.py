"""One city's page."""

from pathlib import Path

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.evaluate.report.page import CityFiles, write_report
from stereotruth.pages.page import INDEX

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input

    def by_scene(files):
        """Files results/<stage>/<city>/<scene>/<file> by scene."""
        return {Path(file).parent.name: file for file in files}

    with rule_job(snakemake, f"report {city}"):
        scenes = by_scene(given.alignments)
        files = CityFiles(
            tiles=given.tiles,
            summary=given.summary,
            coverage=given.coverage,
            looks={scene: Path(given.looks, f"{scene}_left.tif") for scene in scenes},
            alignments=scenes,
            refinements=by_scene(given.refinements),
            residual_figures=by_scene(given.residual_figures),
            refinement_figures=by_scene(given.refinement_figures),
            truth=given.truth[0] if given.truth else None,
            truth_table=given.truth_table[0] if given.truth_table else None,
            table4=given.table4,
            sift=given.sift,
            sift_figure=given.sift_figure,
        )
        write_report(
            city,
            files,
            snakemake.output[0],
            index=INDEX,
            sliders=snakemake.params.sliders,
            workers=snakemake.threads,
            code=snakemake.params.code,
        )
        write_index()
