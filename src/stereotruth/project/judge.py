"""Commands that judge: surface models, methods, boards of methods, datasets and their errata."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from ..core.errors import InputError


def examples(*lines: str) -> str:
    """What stands at the end of a command's help, one line each."""
    return "\n\n".join(["[bold]Examples[/bold]", *(f"[cyan]{line}[/cyan]" for line in lines)])


app = typer.Typer()
errata_app = typer.Typer(no_args_is_help=True, help="Corrected labels of stereo datasets.")
app.add_typer(errata_app, name="errata")


@app.command(
    "score-dsm",
    epilog=examples(
        "stereotruth score-dsm dsm.tif --lidar /data/lidar --to verdict",
        "stereotruth score-dsm dsm.tif --reference truth.tif --to verdict",
        "stereotruth score-dsm dsm.tif --geoid egm08_25.gtx --lidar 'tiles/*.laz' --to verdict",
    ),
)
def score_dsm(
    model: Annotated[Path, typer.Argument(help="GeoTIFF of heights, north-up, in metres.")],
    to: Annotated[Path, typer.Option(help="Folder to be written: scores.json, index.html.")],
    lidar: Annotated[
        str, typer.Option(help="Folder, glob or files of LAS, LAZ, COPC, or GeoTIFFs of heights.")
    ] = "",
    reference: Annotated[Path | None, typer.Option(help="Raster of true heights.")] = None,
    geoid: Annotated[
        Path | None, typer.Option(help="Geoid grid, if the model's heights are orthometric.")
    ] = None,
    lidar_crs: Annotated[str, typer.Option(help="For LiDAR files that declare none.")] = "",
    reference_geoid: Annotated[
        Path | None, typer.Option(help="Geoid grid, if the reference's heights are orthometric.")
    ] = None,
    reference_classes: Annotated[
        Path | None, typer.Option(help="LAS classes on the grid of the reference raster.")
    ] = None,
    epoch: Annotated[str, typer.Option(help="Of the model's images, 2016.4 or a date.")] = "",
) -> None:
    """Judge any surface model: where it lies, its heights by surface and slope, edges of roofs.

    National frames are brought to ITRF2020 at the epoch.
    """
    from ..core.products.files import refuse_others
    from ..core.sheets import lidar_files, store_names
    from ..core.tables import epoch_year
    from ..evaluate.surface_models.reference import LidarReference, RasterReference
    from ..evaluate.surface_models.score import describe, score_surface_model, write_verdict
    from ..lidar.frames import DEFAULT_EPOCH, Epoch, Epochs
    from ..lidar.ingest import ingest

    refuse_others(to, "scores.json")
    if bool(lidar) == (reference is not None):
        raise InputError(
            "a surface model needs one reference", file=model, remedy="give --lidar or --reference"
        )
    try:
        year = epoch_year(epoch)
    except ValueError as error:
        raise InputError(f"--epoch {epoch!r} {error}", file=model, remedy="as 2016.4") from None
    epochs = Epochs(DEFAULT_EPOCH if year is None else Epoch(year, "--epoch"))
    with TemporaryDirectory(prefix="stereotruth-") as scratch:
        if reference is not None:
            against = RasterReference(reference, reference_geoid, reference_classes, epochs=epochs)
        else:
            stores = []
            for name, file in store_names(lidar_files(lidar)).items():
                stores.append(Path(scratch) / f"{name}.points")
                how = {"lidar_crs": lidar_crs, "geoid": reference_geoid, "epochs": epochs}
                ingest(file, stores[-1], **how)
            against = LidarReference(stores)
        verdict = score_surface_model(model, against, geoid=geoid, epochs=epochs)
        figures = write_verdict(verdict, to, model.name)
    typer.echo(f"{model.name}: {describe(figures)}; look at {to / 'index.html'}")


@app.command(
    epilog=examples(
        "stereotruth compare benchmark/exact/sgm --with benchmark/exact/census",
        "stereotruth compare verdict/a verdict/b --with verdict/c --with verdict/d",
        "stereotruth compare results.before --with results",
    )
)
def compare(
    first: Annotated[
        list[Path],
        typer.Argument(
            help="Scores of a method or of a surface model, of several runs a folder each; or a "
            "folder `results`."
        ),
    ],
    second: Annotated[
        list[Path], typer.Option("--with", help="Those of another; may be given again.")
    ],
) -> None:
    """Say on the same tiles whether the second is better or worse than the first, or level; of two
    folders `results`, how far labels have moved from the first to the second."""
    if any(second[0].glob("project/*/*.zarr")):
        from .findings import wide
        from .status import compare_labels

        wide().print(compare_labels(first[0], second[0]))
        return
    from stereobench.scores.paired import compare_folders

    for line in compare_folders(first, second):
        typer.echo(line)


@app.command(
    epilog=examples(
        "stereotruth board challenge --admit",
        "stereotruth board challenge --to public/board",
    )
)
def board(
    folder: Annotated[Path, typer.Argument(help="Has board.yaml and submissions/.")],
    to: Annotated[
        Path | None, typer.Option(help="Folder to be written; default: site/ in the folder.")
    ] = None,
    admit: Annotated[
        bool,
        typer.Option("--admit", help="Take in new submissions, and run their programs."),
    ] = False,
) -> None:
    """Make a static site that ranks submissions, every figure computed from their files.

    A submission that was changed or cannot be used is named, and the site is made without it; the
    exit status is then 1.
    """
    from stereobench.scores.board import make_board

    from ..core.products.files import refuse_others

    if to is not None:
        refuse_others(to, "board.json", folder / "submissions")
    refused = make_board(folder, to, take_in=admit)
    for line in refused:
        typer.echo(f"refused: {line}", err=True)
    typer.echo(f"look at {(to or folder / 'site') / 'index.html'}")
    if refused:
        raise typer.Exit(1)


@app.command(
    epilog=examples(
        "stereotruth dataset data/whole --seal public",
        "stereotruth dataset public --open data/whole",
    )
)
def dataset(
    root: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
    seal: Annotated[
        Path | None,
        typer.Option(help="Folder to be written: a copy that has checksums for labels of a split."),
    ] = None,
    opened: Annotated[
        Path | None,
        typer.Option("--open", help="The dataset that was sealed: take its labels into the copy."),
    ] = None,
    layout: Annotated[str, typer.Option(help="stereotruth, whu, kitti, us3d.")] = "stereotruth",
    split: Annotated[str, typer.Option(help="Split that is sealed.")] = "test",
) -> None:
    """Seal the labels of a split, which a challenge is held on, or open them."""
    from ..tiles.seals import open_seal, seal_dataset
    from ..tiles.stereo_dataset import find_pairs

    if (seal is None) == (opened is None):
        raise InputError("one of two is to be done", file=root, remedy="give --seal or --open")
    if seal is not None:
        typer.echo(seal_dataset(root, find_pairs(root, layout), split, seal))
    else:
        typer.echo(open_seal(root, opened))


@app.command(
    epilog=examples(
        "stereotruth audit /data/Track2 us3d --range -96 96 --to audit/us3d --delta errata/us3d",
    )
)
def audit(
    dataset: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
    layout: Annotated[str, typer.Argument(help="stereotruth, whu, kitti or us3d.")],
    disparities: Annotated[
        tuple[int, int], typer.Option("--range", help="Least disparity and the one above all, px.")
    ],
    to: Annotated[Path, typer.Option(help="Folder to be written: index.html, pairs.csv …")],
    nodata: Annotated[float, typer.Option(help="Value of pixels without a label.")] = -999.0,
    delta: Annotated[
        Path | None, typer.Option(help="Folder for corrected labels, see errata apply.")
    ] = None,
) -> None:
    """Find faults of a stereo dataset from its files; with --delta write how to correct them."""
    from stereobench.audit.audit import audit as audit_dataset
    from stereobench.audit.errata import ERRATA, read_errata

    from ..core.config.methods import Audit
    from ..core.products.files import refuse_others
    from ..tiles.stereo_dataset import StereoDataset

    if disparities[0] >= disparities[1]:
        raise InputError(f"--range {disparities} is empty", remedy="give the smallest one first")
    refuse_others(to, "summary.json", dataset)
    if delta is not None:
        refuse_others(delta, ERRATA, dataset)
    given = StereoDataset(to.name, dataset, layout, disparities, nodata)
    work = to.with_name(f"{to.name}.work")
    summary = audit_dataset(given, to, Audit(), work=work, delta=delta)
    for line in summary["statements"]:
        typer.echo(line)
    typer.echo(f"look at {to / 'index.html'}; {work} has what was measured, for another run")
    if delta is not None:
        said = read_errata(delta)
        typer.echo(f"{delta}: {len(said['tiles'])} pairs, {len(said['not_mended'])} not mended")


@errata_app.command(
    "apply", epilog=examples("stereotruth errata apply errata/us3d /data/Track2 Track2-corrected")
)
def errata_apply(
    delta: Annotated[Path, typer.Argument(help="Folder of the errata.")],
    dataset: Annotated[Path, typer.Argument(help="The dataset, as it was published.")],
    out: Annotated[Path, typer.Argument(help="New folder for the corrected copy.")],
) -> None:
    """Copy a dataset with its labels corrected; refuse files that the errata are not of."""
    from stereobench.audit.errata import apply_errata

    typer.echo(f"{out}: labels of {apply_errata(delta, dataset, out)} pairs corrected")
