"""What is not allowed: one sentence ends the plan."""

from snakemake.logging import logger


class Refused(SystemExit):
    """What users are meant to read, without the lines that it came from: it ends Snakemake."""

    def __init__(self, message):
        logger.error(f"Refused:\n{message}")
        super().__init__(1)
