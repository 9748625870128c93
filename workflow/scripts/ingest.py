"""One LiDAR file to a point store."""

from stereotruth.core.job import in_own_process, job
from stereotruth.core.products.file_parts import prune
from stereotruth.core.products.making import making
from stereotruth.core.products.provenance import describe
from stereotruth.lidar.frames import Epoch, Epochs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import Footprint

if __name__ == "__main__":
    scene, geoid = snakemake.wildcards.scene, snakemake.input.get("geoid") or None
    ground = snakemake.params.footprint
    parameters = {
        "lidar_crs": snakemake.params.lidar_crs,
        "lidar_epoch": snakemake.params.lidar_epoch,
        "epoch": list(snakemake.params.epoch),
        "drop_classes": snakemake.params.drop_classes,
        "acquired": list(snakemake.params.acquired),
    }

    def ingest_file() -> None:
        with making(snakemake.input, snakemake.output):
            ingest(
                snakemake.input.lidar,
                snakemake.output.store,
                footprint=None if ground is None else Footprint.of_runs(ground),
                lidar_crs=parameters["lidar_crs"] or None,
                geoid=geoid,
                epochs=Epochs(Epoch(*parameters["epoch"]), parameters["lidar_epoch"]),
                acquired=snakemake.params.acquired,
                drop_classes=tuple(parameters["drop_classes"]),
                provenance=describe(snakemake.input, parameters, snakemake.params.code),
            )

    with job(snakemake.log[0], f"ingest {scene}"):
        # some damaged LAZ files crash the decoder
        in_own_process(ingest_file, snakemake.input.lidar)
        prune(1e9 * float(snakemake.resources.copies_gb))
