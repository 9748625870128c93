"""One city's labels against its images: SIFT matches (table 4) and image warping."""

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.labels_against_images import evaluate_city

if __name__ == "__main__":
    city, given = snakemake.wildcards.city, snakemake.input
    stores = zip(given.left, given.right, given.disparity)
    with rule_job(snakemake, f"evaluate {city}") as log:
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
