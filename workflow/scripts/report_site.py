"""The page of a site: its images, all pairs, residuals by image, closure."""

from pathlib import Path

from stereotruth.align.images import open_image
from stereotruth.core.products.files import read_json
from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.evaluate.report.site_page import write_site_page
from stereotruth.lidar.point_statistics import roughness_m
from stereotruth.lidar.point_store import PointStore
from stereotruth.pages.page import INDEX
from stereotruth.sensor.site_pairs import rate

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    with rule_job(snakemake, f"site {city}"):
        images = [
            open_image(name, Path(file), *cells)[0]
            for name, (file, *cells) in snakemake.params.images.items()
        ]
        write_site_page(
            city,
            images,
            rate(images, roughness_m([PointStore(path) for path in given.points])),
            snakemake.output[0],
            files={name: file for name, (file, *_) in snakemake.params.images.items()},
            scenes=snakemake.params.scenes,
            adjusted=read_json(given.adjusted[0]) if given.adjusted else {},
            closure=read_json(given.closure[0]) if given.closure else {},
            page=given.page,
            index=INDEX,
        )
        write_index()
