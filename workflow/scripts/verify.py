"""Tiles and dataset, where they exist, against the checksums of their manifests."""

from pathlib import Path

from stereotruth.core.errors import InputError
from stereotruth.core.job import job
from stereotruth.tiles.verify import verify

if __name__ == "__main__":
    with job(snakemake.log[0], "verify"):
        folders = [folder for folder in snakemake.params.folders if Path(folder).is_dir()]
        if not folders:
            raise InputError("no tiles to verify", remedy="make some: snakemake tiles/<City>")
        verify(folders)
