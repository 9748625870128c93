"""Sheets, validation, wildcard constraints, and the input functions of all stages."""

import json
import re
from argparse import Namespace
from pathlib import Path

from snakemake.exceptions import WorkflowError

from stereotruth import sheets
from stereotruth.errors import InputError
from stereotruth.products.locks import FileLock
from stereotruth.matching.kinds import LABELS as METHOD_LABELS, MODULES as METHOD_MODULES
from stereotruth.products.provenance import PACKAGE, file_sha256, source_digest
from stereotruth.simulate.cities import CITIES as SYNTHETIC, lidar_files as synthetic_lidar

SCHEMAS = Path(workflow.basedir) / "workflow" / "schemas"
CONDA = Path(workflow.basedir) / "envs" / "workflow.yaml"
SYNTHETIC_FOLDER = "data/synthetic"
VIEWS = ("left", "right")


def is_synthetic(scene):
    """Whether the scene's input is made by the rules of simulate.smk."""
    city = SYNTHETIC.get(scene.city)
    made_here = f"{SYNTHETIC_FOLDER}/{scene.city}/{scene.scene}"
    return city is not None and scene.left_image == f"{made_here}/left.tif"


def synthetic_scenes(city):
    """Names of a city's synthetic scenes, in the order of the sheet."""
    return [s.scene for s in SCENES.values() if s.city == city and is_synthetic(s)]


def read_sheets():
    """Cities and scenes by name, and the LiDAR files of each scene by store name."""
    sheets.check(config, "config", SCHEMAS, "config")
    cities = sheets.read_cities(config["cities"], SCHEMAS)
    scenes = sheets.read_scenes(config["scenes"], cities, SCHEMAS)
    lidar = {}
    for name, scene in scenes.items():
        sheet = config["scenes"]
        aligned = config["alignment"]["refine"] or name in config["alignment"]["fixed"]
        if not scene.gcps and not aligned:
            raise InputError(
                f"scene {name!r} has no GCPs, and alignment.refine is false",
                file=sheet,
                remedy="name its file of ground control points, or set alignment.refine to true",
            )
        if is_synthetic(scene):
            sheets.require_files(scene, sheet, ["gcps"])
            tiles = synthetic_lidar(SYNTHETIC[scene.city], name)
            files = [Path(scene.lidar) / tile for tile in tiles]
        else:
            sheets.require_files(scene, sheet, ["left_image", "right_image", "gcps", "geoid"])
            files = sheets.find_lidar(scene, sheet)
        lidar[name] = sheets.store_names(files)
    for name, file in config["alignment"]["fixed"].items():
        if name not in scenes or not Path(file).is_file():
            raise InputError(
                f"alignment.fixed: {name}: {file}: "
                + ("no such file" if name in scenes else "no such scene"),
                file=config["scenes"],
                remedy="take a scene of the sheet, and the path of its alignment.json",
            )
    return cities, scenes, lidar


try:
    CITIES, SCENES, LIDAR = read_sheets()
except InputError as error:
    raise WorkflowError(str(error))


wildcard_constraints:
    city="|".join(CITIES),
    scene="|".join(SCENES),
    view="left|right",
    side="|_right",
    strip="[0-9]+-of-[0-9]+",
    lidar="[^/]+",


def scenes_of(city):
    """The scenes of a city, in the order of the sheet."""
    if city not in CITIES:
        raise WorkflowError(
            f"{config['cities']}: no city {city!r}. "
            f"Remedy: take one of {', '.join(CITIES)}, or add a row"
        )
    found = [scene for scene in SCENES.values() if scene.city == city]
    if not found:
        raise WorkflowError(f"{config['scenes']}: no scene of city {city!r}. Remedy: add a row")
    return found


def with_rpc_files(image):
    """An image and the RPC files beside it, so that an edited RPC is seen."""
    image = Path(image)
    beside = [image.with_suffix(s) for s in (".RPB", ".rpb")]
    beside += [image.with_name(f"{image.stem}{s}") for s in ("_RPC.TXT", "_rpc.txt", "_RPC.txt")]
    return [str(image), *(str(file) for file in beside if file.is_file())]


def left_image(wildcards):
    return with_rpc_files(SCENES[wildcards.scene].left_image)


def right_image(wildcards):
    return with_rpc_files(SCENES[wildcards.scene].right_image)


def alignment_of(wildcards):
    """The alignment that the scene's rectified images and labels are made with."""
    if given := config["alignment"]["fixed"].get(wildcards.scene):
        return given
    stage = "refine" if config["alignment"]["refine"] else "align"
    return f"results/{stage}/{wildcards.city}/{wildcards.scene}/alignment.json"


def refinements(wildcards):
    """The alignments that a city's labels are made with, where they are not those of rule align."""
    files = [alignment_of(scene) for scene in scenes_of(wildcards.city)]
    return [file for file in files if file.startswith("results/refine/")]


def strips_made(wildcards, file):
    """The files that tell that the strips of a scene are made; none if one job makes it all."""
    strips = config["strips"]
    count = strips if isinstance(strips, int) else strips.get(wildcards.scene, 1)
    names = [f"{k}-of-{count}" for k in range(count)] if count > 1 else []
    return expand(file, **wildcards, strip=names)


def truth_of_city(city, kind):
    """The city's figures against the exact truth (json, csv), if it has synthetic scenes."""
    return [f"results/evaluate/{city}/truth.{kind}"] if synthetic_scenes(city) else []


def point_stores(wildcards):
    return expand(
        "results/ingest/{city}/{scene}/{lidar}.zarr",
        city=wildcards.city,
        scene=wildcards.scene,
        lidar=LIDAR[wildcards.scene],
    )


LOCKS = []  # held until this process ends


def refuse_second_run():
    """End this run if another one works in this directory.

    Snakemake's own lock stays when it is killed; this one does not (profiles/default turns the
    other off).
    """
    lock = FileLock(".snakemake/run.lock")
    if not lock.take(Path.cwd(), wait=False):
        raise WorkflowError(
            f"{Path.cwd()}: another run is at work here ({lock.holder}). "
            "Remedy: wait until it ends, or stop it"
        )
    LOCKS.append(lock)


onstart:
    refuse_second_run()


def complaints(snakemake_logs):
    """The errors that the failed jobs of a run have logged, one line each."""
    text = "".join(Path(file).read_text() for file in snakemake_logs)
    logs = re.findall(r"^\s+log: (\S+) \(check log", text, flags=re.MULTILINE)
    found = []
    for file in filter(Path.is_file, map(Path, dict.fromkeys(logs))):
        found += re.findall(r"ERROR (.*?: error: .*)", file.read_text())
    return "\n".join(found)


def made():
    """What the last lines of a run say: the tiles that there are, and where to look."""
    summaries = [Path("results", "export", city, "summary.json") for city in CITIES]
    lines = [
        line
        for file in summaries
        if file.is_file()
        for line in json.loads(file.read_text())["lines"]
    ]
    return "\n".join(["", *lines]) if lines else "done"


def dataset_settings(name):
    """The entry of a dataset in the configuration's section benchmark."""
    known = {n: of for n, of in config["benchmark"]["datasets"].items() if of}
    if name not in known:
        raise WorkflowError(
            f"benchmark.datasets: no dataset {name!r}. "
            f"Remedy: take one of {', '.join(known)}, or add it to your configuration"
        )
    return known[name]


def dataset_folder(name):
    """The root of a dataset; the workflow makes its own."""
    root = str(Path(dataset_settings(name)["root"]))
    if root != "dataset" and not Path(root).is_dir():
        raise WorkflowError(
            f"benchmark.datasets.{name}.root: {root}: no such folder. "
            "Remedy: name the dataset's folder"
        )
    return root


def is_own_dataset(name):
    """Whether the workflow makes the dataset."""
    return dataset_folder(name) == "dataset"


def method_settings(name):
    """The entry of a method in the configuration's section benchmark."""
    known = {n: of for n, of in config["benchmark"]["methods"].items() if of}
    if name not in known:
        raise WorkflowError(
            f"benchmark.methods: no method {name!r}. "
            f"Remedy: take one of {', '.join(known)}, or add it to your configuration"
        )
    return known[name]


def methods_of(dataset):
    """Names of the methods that are compared on a dataset."""
    known = [n for n, of in config["benchmark"]["methods"].items() if of]
    return dataset_settings(dataset).get("methods") or known


def method_files(wildcards):
    """Files that a method is made of: weights, the user's code, results to be scored."""
    settings = method_settings(wildcards.method)
    match settings["kind"]:
        case "sgm":
            return []
        case "function":
            file = settings.get("function", "").rpartition(":")[0]
            return [file] if file.endswith(".py") else []
        case "folder":
            folder = Path(settings.get("folder", ""))
            return sorted(str(file) for file in folder.glob("*") if file.is_file())
    weights = settings.get("weights")
    return [weights or f"results/train/{wildcards.dataset}/{wildcards.method}/best.pt"]


def training_of(name):
    """How a network is trained: section training, and what the method's entry has other."""
    own = method_settings(name).get("training") or {}
    return {"seed": config["seed"], **config["training"], **own}


def method_modules(name):
    """Modules of the package that hold a method's own code."""
    own = METHOD_MODULES.get(method_settings(name)["kind"])
    return [] if own is None else [own]


def method_label(name):
    """How tables call a method."""
    return method_settings(name).get("label") or METHOD_LABELS.get(name, name)


def products_of_own_dataset():
    """What tells the strata of the workflow's own dataset: status, classes, exact truth."""
    scenes = SCENES.values()
    return [
        *(f"tiles/{city}" for city in CITIES),
        *(f"results/project/{s.city}/{s.scene}.zarr" for s in scenes),
        *(f"results/truth/{s.city}/{s.scene}.zarr" for s in scenes if is_synthetic(s)),
    ]


def scene_method(name):
    """What the disparities of a scene by a method follow from: no names, nor its training."""
    names = ("label", "fine_tuned_of", "training")
    return {key: value for key, value in method_settings(name).items() if key not in names}


def scene_method_files(wildcards):
    """Files that a method is made of which goes over whole scenes."""
    of = Namespace(dataset=config["predict"]["dataset"], method=wildcards.method)
    return method_files(of)


def scene_prediction():
    """How methods go over whole scenes; the disparity range is that of their dataset."""
    settings = config["predict"]
    known = dataset_settings(settings["dataset"])["disparity_range"]
    return {
        "disparity_range": settings["disparity_range"] or known,
        **{key: settings[key] for key in ("block_px", "overlap_px", "margin_px", "offset")},
    }
