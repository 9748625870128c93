"""One city's labels against its images: SIFT matches (table 4) and image warping."""

from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.evaluate.labels_against_images import evaluate_city

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    stores = zip(given.left, given.right, given.disparity)
    with (
        job(snakemake.log[0], f"evaluate {city}") as log,
        making(snakemake.input, snakemake.output),
    ):
        table = evaluate_city(
            city,
            given.tiles,
            given.matches,
            dict(zip(snakemake.params.scenes, stores)),
            **dict(snakemake.output.items()),
        )
        for row in table:
            log.info(
                "%s: %d pairs, %d matches, mean of mean errors %s px, of mean absolute ones %s px",
                *list(row.values())[:5],
            )
