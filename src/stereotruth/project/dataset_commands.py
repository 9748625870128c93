"""Commands that take any stereo dataset, without a project."""

from __future__ import annotations

from pathlib import Path
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
    from stereobench.audit.errata import read_errata

    from ..core.config.methods import Audit
    from ..tiles.stereo_dataset import StereoDataset

    if disparities[0] >= disparities[1]:
        raise InputError(f"--range {disparities} is empty", remedy="give the smallest one first")
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
