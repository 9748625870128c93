"""The groups of commands `scene` and `gcps`, and what all commands share."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import InputError

scene_app = typer.Typer(no_args_is_help=True, help="The scenes of the project.")
gcps_app = typer.Typer(no_args_is_help=True, help="Ground control points.")
Configured = Annotated[
    list[Path] | None,
    typer.Option("--configfile", help="Read this instead of config.yaml; may be given again."),
]
AllowedHosts = Annotated[
    list[str] | None,
    typer.Option(help="Another host of which the catalogue may name tiles; may be given again."),
]


def examples(*lines: str) -> str:
    """What stands at the end of a command's help, one line each."""
    return "\n\n".join(["[bold]Examples[/bold]", *(f"[cyan]{line}[/cyan]" for line in lines)])


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


def print_lines(lines: Iterable[str]) -> None:
    """One line each."""
    for line in lines:
        typer.echo(line)


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
        list[Path], typer.Argument(help="Folder of the delivery, or left and right image.")
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
    configfile: Configured = None,
) -> None:
    """Find images, RPCs and views in a delivery, look at the LiDAR, and write the scene's row."""
    from .add_scene import add_scene

    print_lines(
        add_scene(
            delivery,
            lidar=lidar,
            gcps=gcps,
            city=city,
            name=scene,
            lidar_crs=lidar_crs,
            geoid=geoid,
            hosts=allow_host or (),
            configfiles=configfile,
        )
    )


@scene_app.command("list", epilog=examples("stereotruth scene list"))
def scene_list(configfile: Configured = None) -> None:
    """The scenes of the project: city, images and LiDAR of each."""
    from .add_scene import list_scenes

    print_lines(list_scenes(configfile))


@scene_app.command("remove", epilog=examples("stereotruth scene remove Marseille-1"))
def scene_remove(
    scene: Annotated[str, typer.Argument(help="Name of the scene.")],
    configfile: Configured = None,
) -> None:
    """Take a scene's row out of the scenes sheet; what was made of it stays."""
    from .add_scene import remove_scene

    typer.echo(remove_scene(scene, configfile))


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
        Path | None, typer.Option(help="Geoid grid, if the heights are orthometric.")
    ] = None,
    left: Annotated[str, typer.Option(help="Name of the left image in a .gcp file.")] = "",
    right: Annotated[str, typer.Option(help="Name of the right image in a .gcp file.")] = "",
    epoch: Annotated[
        str, typer.Option(help="Epoch of the coordinates, 2016.4 or a date; empty: of the images.")
    ] = "",
) -> None:
    """Bring control points of QGIS, Ames Stereo Pipeline or a CSV into the project's form."""
    from .import_gcps import import_gcps

    print_lines(
        import_gcps(
            files, to, heights=heights, crs=crs, geoid=geoid, left=left, right=right, epoch=epoch
        )
    )
