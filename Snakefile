"""Satellite pairs + LiDAR + GCPs -> epipolar image pairs with ground-truth disparity."""

from pathlib import Path

from snakemake.utils import min_version

from stereotruth.core.errors import InputError, in_words
from stereotruth.project.project import read_mapping

min_version("9.10")
# Parallelism belongs to Dask and Snakemake: threads of linear algebra that wait for a core in use
# take up to 70 times the processor time of one.
shell.prefix("set -euo pipefail; export OPENBLAS_NUM_THREADS=1; ")


# Of the working directory, for who runs jobs in a container (--sdm apptainer): see envs/README.md.
container: "stereotruth.sif"


include: "workflow/rules/refused.smk"


OWN_CONFIG = Path("config/config.yaml")  # of the working directory; see common.smk
try:
    with in_words():
        has_config = OWN_CONFIG.is_file()
    if has_config:
        read_mapping(OWN_CONFIG)  # Snakemake names no file that it cannot read
except InputError as error:
    raise Refused(str(error))

if has_config:

    configfile: str(OWN_CONFIG)


include: "workflow/rules/common.smk"
include: "workflow/rules/sources.smk"
include: "workflow/rules/inputs.smk"
include: "workflow/rules/methods.smk"
include: "workflow/rules/run.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/strips.smk"
include: "workflow/rules/align.smk"
include: "workflow/rules/refine.smk"
include: "workflow/rules/adjust.smk"
include: "workflow/rules/rectify.smk"
include: "workflow/rules/surface.smk"
include: "workflow/rules/project.smk"
include: "workflow/rules/image_heights.smk"
include: "workflow/rules/closure.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/evaluate_images.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/training_cities.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/benchmark.smk"
include: "workflow/rules/predict.smk"
include: "workflow/rules/audit.smk"


rule all:
    default_target: True
    input:
        expand("tiles/{city}", city=CITIES),


report: "workflow/report/workflow.rst"
