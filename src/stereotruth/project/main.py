"""The command line of ``stereotruth``. Stages are imported by who needs them, to start quickly."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from .. import __version__
from ..core.errors import InputError, told_by_system
from .judge import app as judge_app
from .judge import examples

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "stereotruth init --example demo && cd demo",
        "stereotruth check",
        "stereotruth run tiles/Demo",
        "stereotruth run report && stereotruth open",
    ),
    help="Satellite pairs, LiDAR and ground control points to epipolar pairs with ground-truth "
    "disparity. Commands work in the folder of a project, where config.yaml lies.",
)
scene_app = typer.Typer(no_args_is_help=True, help="The scenes of the project.")
gcps_app = typer.Typer(no_args_is_help=True, help="Ground control points.")
app.add_typer(scene_app, name="scene")
app.add_typer(gcps_app, name="gcps")
Configured = Annotated[
    list[Path] | None,
    typer.Option("--configfile", help="Read this instead of config.yaml; may be given again."),
]
AllowedHosts = Annotated[
    list[str] | None,
    typer.Option(help="Another host of which the catalogue may name tiles; may be given again."),
]


def complete(context: typer.Context) -> list[str]:
    """For the shell: targets, profiles or cities, as the command wants; none without a project."""
    from .run_workflow import completions

    of_profile = context.info_name == "profile"
    with suppress(InputError, OSError):
        found = completions(["--profile"] if of_profile else context.params.get("given") or [])
        if of_profile or context.info_name == "run":
            return found
        return [word.removeprefix("tiles/") for word in found if word.startswith("tiles/")]
    return []


named = partial(typer.Argument, autocompletion=complete)


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"stereotruth {__version__}")
        raise typer.Exit


@app.callback()
def _callback(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    del version


@app.command(
    epilog=examples(
        "stereotruth init my-project",
        "stereotruth init --example demo",
        "stereotruth init --example site",
        "stereotruth init --twin place.laz --crs EPSG:2154 twin",
    )
)
def init(
    folder: Annotated[
        Path | None,
        typer.Argument(help="A new or an empty folder; default: the example's name."),
    ] = None,
    example: Annotated[
        str,
        typer.Option(
            help="Simulate a small city in it, to try: demo (a pair) or site (a stack of images)."
        ),
    ] = "",
    twin: Annotated[
        Path | None,
        typer.Option(
            help="LAS or LAZ file of a real place: the project's images, LiDAR and exact truth are "
            "simulated over its ground, roofs and crowns."
        ),
    ] = None,
    crs: Annotated[str, typer.Option(help="CRS of a --twin without one.")] = "",
    density: Annotated[
        float | None, typer.Option(help="Points per m² of the twin's LiDAR; default 6.25.")
    ] = None,
    sun: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Azimuth and elevation of the twin's sun, degrees; default 148 54."),
    ] = None,
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(
            help="Columns and rows of the twin's left image, about the middle of the place; "
            "default: all of it."
        ),
    ] = None,
    rpc: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            help="Images with RPCs, or texts of RPCs: the twin's left and right image see the "
            "place as they do; default: GaoFen-7."
        ),
    ] = None,
) -> None:
    """Begin a project: config.yaml, gcps/, and sheets of scenes, cities and images."""
    if twin is not None:
        from stereocities.twin_world import SUN_DEG

        from .simulated_project import DENSITY, Options, with_twin

        to: Path | str = folder or Path("twin")
        options = Options(crs, density or DENSITY, sun or SUN_DEG, size, rpc)
        next_step = with_twin(Path(to), twin, options)
    else:
        if crs or density or sun or size or rpc:
            raise InputError(
                "--crs, --density, --sun, --size and --rpc are of a twin", remedy="add --twin FILE"
            )
        to = example if folder is None else folder
        if example:
            from .simulated_project import with_example

            next_step = with_example(to, example)
        else:
            from .new_project import begin

            next_step = begin(to)
    go = "" if Path(to) == Path() else f"cd {to}, then "
    typer.echo(f"{to}: a project. Next: {go}{next_step}")


@scene_app.command(
    "add",
    epilog=examples(
        "stereotruth scene add /data/GF7_DLC_E115.4_N30.2 --lidar /data/lidar --city Qichun",
        "stereotruth scene add left.tif right.tif --lidar lidar --gcps gcps.csv --city Marseille",
        "stereotruth scene add delivery --lidar lidar --lidar-crs EPSG:2154+5720 --geoid RAF20.tif",
    ),
)
def scene_add(
    delivery: Annotated[
        list[Path],
        typer.Argument(help="Folder of the delivery, or left and right image, or many of a place."),
    ],
    lidar: Annotated[
        str,
        typer.Option(
            help="Folder, glob or files of LAS, LAZ, COPC, or GeoTIFFs of heights; or a catalogue."
        ),
    ],
    gcps: Annotated[str, typer.Option(help="CSV of ground control points, if any.")] = "",
    city: Annotated[str, typer.Option(help="City; default: the delivery's name.")] = "",
    scene: Annotated[str, typer.Option("--name", help="Name of the scene; default: City-1 …")] = "",
    lidar_crs: Annotated[str, typer.Option(help="CRS of LiDAR files without one.")] = "",
    geoid: Annotated[str, typer.Option(help="Geoid grid of orthometric heights.")] = "",
    allow_host: AllowedHosts = None,
    column: Annotated[str, typer.Option(help="Of a tile index, with locations.")] = "",
    configfile: Configured = None,
) -> None:
    """Find images, RPCs and views in a delivery, look at the LiDAR, and write the scene's row."""
    from .add_scene import add_scene

    _print(
        add_scene(
            delivery,
            lidar=lidar,
            gcps=gcps,
            city=city,
            name=scene,
            lidar_crs=lidar_crs,
            geoid=geoid,
            hosts=allow_host or (),
            column=column,
            configfiles=configfile,
        )
    )


@gcps_app.command(
    "import",
    epilog=examples(
        "stereotruth gcps import left.points right.points --heights heights.csv --to gcps/A-1.csv",
        "stereotruth gcps import left.points right.points --heights dsm.tif --to gcps/A-1.csv",
        "stereotruth gcps import points.gcp --left left.tif --right right.tif --to gcps/A-1.csv",
        "stereotruth gcps import survey.csv --crs EPSG:32650 --to gcps/A-1.csv",
    ),
)
def gcps_import(
    files: Annotated[
        list[Path], typer.Argument(help="Two .points (left, right), one .gcp, or one .csv.")
    ],
    to: Annotated[Path, typer.Option(help="The CSV to be written.")],
    heights: Annotated[
        Path | None,
        typer.Option(help="For .points: CSV (id or lon,lat; height) or a raster of heights."),
    ] = None,
    crs: Annotated[str, typer.Option(help="CRS of a file that declares none.")] = "",
    geoid: Annotated[
        Path | None,
        typer.Option(help="Geoid grid of orthometric heights; none: they are ellipsoidal."),
    ] = None,
    left: Annotated[str, typer.Option(help="Name of the left image in a .gcp file.")] = "",
    right: Annotated[str, typer.Option(help="Name of the right image in a .gcp file.")] = "",
    epoch: Annotated[
        str, typer.Option(help="Epoch of the coordinates, 2016.4 or a date; empty: of the images.")
    ] = "",
) -> None:
    """Bring control points of QGIS, Ames Stereo Pipeline or a CSV into the project's form."""
    from .import_gcps import import_gcps

    _print(
        import_gcps(
            files, to, heights=heights, crs=crs, geoid=geoid, left=left, right=right, epoch=epoch
        )
    )


@app.command(
    "lidar",
    epilog=examples(
        "stereotruth lidar tiles.vpc Marseille --to lidar/Marseille.tsv",
        "stereotruth lidar https://example.org/index.gpkg --column url --to lidar/all.tsv",
    ),
)
def lidar_tiles(
    catalogue: Annotated[
        str, typer.Argument(help="VPC, STAC items, or a tile index (GeoJSON, GeoPackage); or URL.")
    ],
    scenes: Annotated[
        list[str] | None, typer.Argument(help="Scenes or cities that need tiles; default: all.")
    ] = None,
    to: Annotated[str, typer.Option(help="List to write, for the column lidar.")] = "",
    allow_host: AllowedHosts = None,
    column: Annotated[str, typer.Option(help="Of a tile index, with locations.")] = "",
    dates: Annotated[
        tuple[str, str], typer.Option(help="Columns of a tile index: first and last day.")
    ] = ("", ""),
    configfile: Configured = None,
) -> None:
    """List the tiles of a catalogue that lie on the ground of scenes; rows then name the list."""
    from .list_tiles import list_of_scenes

    _print(
        list_of_scenes(
            catalogue,
            to,
            scenes or [],
            hosts=allow_host or (),
            column=column,
            dates=dates if all(dates) else None,
            configfiles=configfile,
        )
    )


@app.command(
    epilog=examples(
        "stereotruth check", "stereotruth check Marseille-1", "stereotruth check && stereotruth run"
    )
)
def check(
    scenes: Annotated[
        list[str] | None, named(help="Scenes or cities; all if none is named.")
    ] = None,
    configfile: Configured = None,
) -> None:
    """Say in seconds what would make a run fail, how many tiles come, and the time it takes."""
    from .check import check_project
    from .findings import show

    if show(check_project(configfile, scenes or [], partial(typer.echo, err=True))):
        raise typer.Exit(1)


@app.command(
    epilog=examples(
        "stereotruth pairs Marseille",
        "stereotruth pairs Marseille --most 20 --convergence 5 40 --lidar lidar",
        "stereotruth pairs Marseille --diachronic --each 3",
    )
)
def pairs(
    city: Annotated[str, named(help="City of the images sheet.")],
    most: Annotated[int | None, typer.Option(min=1, help="Write the best so many.")] = None,
    convergence: Annotated[
        tuple[float, float], typer.Option(help="Write pairs from … to degrees of convergence.")
    ] = (5.0, 45.0),
    days: Annotated[
        tuple[float, float] | None, typer.Option(help="Write pairs from … to days apart.")
    ] = None,
    diachronic: Annotated[
        bool, typer.Option("--diachronic", help="Write pairs of two lights.")
    ] = False,
    each: Annotated[
        int | None, typer.Option(min=1, help="Write at most so many pairs of each image.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Write all pairs.")] = False,
    lidar: Annotated[str, typer.Option(help="Of new rows; default: the city's first.")] = "",
    gcps: Annotated[str, typer.Option(help="Control points of new rows; likewise.")] = "",
    lidar_crs: Annotated[str, typer.Option(help="CRS of that LiDAR; likewise.")] = "",
    geoid: Annotated[str, typer.Option(help="Geoid of that LiDAR; likewise.")] = "",
    configfile: Configured = None,
) -> None:
    """List the pairs of a site, best first; with a choice, write it to the scenes sheet."""
    from .pairs import CONVERGENCE_DEG, Choice, list_pairs, show_pairs

    limits = (most, days, each, convergence if convergence != CONVERGENCE_DEG else None)
    choice = None
    if every:
        choice = Choice(most, None, days, diachronic, each)
    elif diachronic or any(limit is not None for limit in limits):
        choice = Choice(most, convergence, days, diachronic, each)
    given = {"lidar": lidar, "gcps": gcps, "lidar_crs": lidar_crs, "geoid": geoid}
    listing = list_pairs(city, choice, given, configfile)
    show_pairs(listing.rated, listing.chosen)
    _print(listing.lines)


@app.command(
    context_settings=PASSED_ON,
    options_metavar="",
    short_help="Make tiles, pages or datasets: all that [cyan]stereotruth targets[/cyan] lists.",
    help="Run the workflow in this folder, with its config.yaml; without a target it makes the "
    "tiles of all cities. [cyan]stereotruth targets[/cyan] lists what can be made. Any option goes "
    "to Snakemake as it is; where none says how many cores, it takes all. "
    "[cyan]--example[/cyan] runs the built-in synthetic cities.",
    epilog=examples(
        "stereotruth run tiles/Marseille",
        "stereotruth run tiles/Marseille report --cores 8 --dry-run",
        "stereotruth run --profile my-site dataset",
        "stereotruth run benchmark/synthetic/sgm -- --keep-going",
    ),
)
def run(
    context: typer.Context,
    given: Annotated[
        list[str] | None, named(hidden=True, metavar="[TARGET …] [OPTIONS OF SNAKEMAKE]")
    ] = None,
) -> None:
    """Run the workflow; see ``help`` above."""
    from .run_workflow import run_workflow

    if given in (["--help"], ["-h"]):
        typer.echo(context.get_help())
        raise typer.Exit
    run_workflow(given or [])


@app.command(epilog=examples("stereotruth targets", "stereotruth run report"))
def targets(configfile: Configured = None) -> None:
    """List what a run can make, one line each, and the names to put in."""
    from .run_workflow import list_targets

    _print(list_targets(configfile))


@app.command(
    epilog=examples(
        "stereotruth profile",
        "stereotruth profile slurm my-site",
        "stereotruth run --profile my-site tiles/Marseille",
    )
)
def profile(
    name: Annotated[str, named(help="The profile; without one, list them.")] = "",
    folder: Annotated[
        Path | None, typer.Argument(help="Folder to be written; else the profile's name.")
    ] = None,
) -> None:
    """List the profiles of the package, or copy one here, to set account and partition in it."""
    from .new_project import copy_profile, list_profiles

    _print([copy_profile(name, folder)] if name else list_profiles())


@app.command(epilog=examples("stereotruth status", "stereotruth status Marseille"))
def status(
    cities: Annotated[list[str] | None, named(help="All if none is named.")] = None,
    configfile: Configured = None,
) -> None:
    """Say what is made of each city, and what is out of date and why."""
    from .status import show_status

    show_status(cities or [], configfile)


app.add_typer(judge_app)


@app.command("open", epilog=examples("stereotruth open", "stereotruth open Marseille"))
def open_pages(
    words: Annotated[
        list[str] | None, typer.Argument(help="Only pages with one of these in their path.")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Print their paths only.")] = False,
) -> None:
    """Open the index of all pages (cities, benchmarks, audits), or those that are named."""
    from ..evaluate.report.index_page import pages_with

    found = pages_with(words or [])
    for page in found:
        typer.echo(str(page))
    for page in [] if listed else found if words else found[:1]:
        typer.launch(page.absolute().as_uri())


def main() -> None:
    """Entry point: an error of the input, or of the system, is one line, and exit status 1."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # ? for what LC_ALL=C cannot show
        sys.stdout.reconfigure(errors="replace")
    compiling = logging.getLogger("stereotruth.compiling")
    compiling.setLevel(logging.INFO)
    compiling.addHandler(terminal := logging.StreamHandler(sys.stderr))
    try:
        app()
    except (InputError, OSError) as error:
        told = error if isinstance(error, InputError) else told_by_system(error)
        if told is None:
            raise
        sys.stderr.write(f"error: {told}\n")
        raise SystemExit(1) from None
    finally:
        compiling.removeHandler(terminal)


if __name__ == "__main__":
    main()
