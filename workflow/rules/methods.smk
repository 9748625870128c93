"""Datasets and stereo methods of the configuration."""

import re
from functools import cache

from snakemake.logging import logger

from stereobench.methods.kinds import KINDS, kind_of
from stereotruth.core.config.methods import SceneMatching
from stereotruth.tiles.seals import is_shut


def dataset_settings(name):
    """The entry of a dataset in the configuration's section benchmark."""
    known = {n: of for n, of in SETTINGS.benchmark.datasets.items() if of}
    if name not in known:
        raise Refused(
            f"benchmark.datasets: no dataset {name!r}. "
            f"Remedy: take one of {', '.join(known)}, or add it to your configuration"
        )
    return known[name]


def dataset_entry(name):
    """What a dataset is: its entry without the methods that are compared on it, and how."""
    return dataset_settings(name).model_dump(exclude={"methods", "protocol"})


def dataset_folder(name):
    """The root of a dataset; the workflow makes its own, and those of training cities."""
    root = str(Path(dataset_settings(name).root))
    made_here = root == "dataset" or re.fullmatch("results/training_cities/[1-9][0-9]*", root)
    if not made_here and not Path(root).is_dir():
        raise Refused(
            f"benchmark.datasets.{name}.root: {root}: no such folder. "
            "Remedy: name the dataset's folder"
        )
    return given(root)


def is_own_dataset(name):
    """Whether the workflow makes the dataset."""
    return dataset_folder(name) == "dataset"


def is_sealed(name):
    """Whether a dataset's labels are to be opened later, so that nobody can score as yet."""
    return is_shut(dataset_settings(name).root)


def method_settings(name):
    """The entry of a method in the configuration's section benchmark."""
    known = {n: of for n, of in SETTINGS.benchmark.methods.items() if of}
    if name not in known:
        raise Refused(
            f"benchmark.methods: no method {name!r}. "
            f"Remedy: take one of {', '.join(known)}, or add it to your configuration"
        )
    return known[name]


def needs_training(method):
    """Whether a method is a network that the workflow has to train first."""
    of = method_settings(method)
    return KINDS[of.kind].is_network and not of.weights


LEFT_OUT = {}  # what to say of methods that are not compared, by dataset


@cache
def methods_of(dataset):
    """Names of the methods that are compared on a dataset; of all, those that need no training."""
    if chosen := dataset_settings(dataset).methods:
        return list(chosen)
    known = [n for n, of in SETTINGS.benchmark.methods.items() if of]
    left_out = [name for name in known if needs_training(name)]
    if left_out:
        LEFT_OUT[dataset] = (
            f"Left out on {dataset}, since they would be trained first: {', '.join(left_out)}. "
            "To compare them, give them weights, or name them in "
            f"benchmark.datasets.{dataset}.methods"
        )
        logger.warning(LEFT_OUT[dataset])
    if known == left_out:
        raise Refused(
            f"benchmark.datasets.{dataset}: no method that needs no training. "
            f"Remedy: name some of {', '.join(known)} in its entry methods"
        )
    return [name for name in known if name not in left_out]


def method_entry(name, dataset):
    """What the disparities by a method follow from: no names, nor its training.

    A network without weights takes those that it is trained to on the dataset.
    """
    names = {"label", "fine_tuned_of", "training"}
    entry = method_settings(name).model_dump(exclude_defaults=True, exclude=names)
    if KINDS[entry["kind"]].is_network:
        entry["weights"] = entry.get("weights") or f"results/train/{dataset}/{name}/best.pt"
    return entry


def method_files(name, dataset):
    """Files that a method is made of: weights, the user's code, results to be scored.

    Ends the plan if the method has settings that its kind does not know.
    """
    try:
        kind = kind_of(name, method_settings(name).model_dump(exclude_defaults=True))
        return [given(file) for file in kind.files(method_entry(name, dataset))]
    except InputError as error:
        raise Refused(f"benchmark.methods.{name}: {error}")


def training_of(name):
    """How a network is trained: section training, and what the method's entry has other."""
    own = method_settings(name).training
    return {"seed": SETTINGS.seed, **SETTINGS.training.model_dump(), **own}


def method_modules(name):
    """Modules of the package that hold a method's own code."""
    return KINDS[method_settings(name).kind].modules


def method_label(name):
    """How tables call a method."""
    return method_settings(name).label or KINDS.get(name, KINDS["function"]).label or name


def products_of_own_dataset():
    """What tells the strata of the workflow's own dataset: status, classes, exact truth."""
    scenes = SCENES.values()
    return [
        *(f"tiles/{city}" for city in CITIES),
        *(f"results/project/{s.city}/{s.scene}.zarr" for s in scenes),
        *(f"results/truth/{s.city}/{s.scene}.zarr" for s in scenes if is_synthetic(s)),
    ]


def prediction_dataset():
    """The dataset that whole scenes go by: the one that predict names, else the first."""
    known = (name for name, of in SETTINGS.benchmark.datasets.items() if of)
    return SETTINGS.predict.dataset or next(known, "synthetic")


def scene_prediction():
    """How methods go over whole scenes; the disparity range is that of their dataset."""
    own = SETTINGS.predict.model_dump(include=set(SceneMatching.model_fields))
    known = dataset_settings(prediction_dataset()).disparity_range
    return own | {"disparity_range": own["disparity_range"] or known}
