"""`pagas-cl check`: are these the right cameras for this mesh and these photos?"""

import json
import sys
from pathlib import Path

import typer

from pagas_cl.commands._start import load_scene


def command(
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with photos and cameras, in any known format."),
    mesh: Path = typer.Option(..., "--mesh", help="The mesh that the cameras should see."),
    format: str = typer.Option(None, "--format", help="Format of the scene, where looking at it is not enough."),
    outside: bool = typer.Option(False, "--outside", help="Allow files outside SCENE (scenes that you trust)."),
    as_json: bool = typer.Option(False, "--json", help="Print everything as JSON."),
):
    """Check the cameras of SCENE against a mesh and the photos.

    Estimates the offset and scale of the mesh that would make the photos agree, too. Status 2 when another reading of
    the cameras fits better, when none sees the mesh, or when mesh and cameras are pixels of parallax apart.
    """
    from pagas_cl.errors import InputError
    from pagas_cl.scene.check import check_views

    found = load_scene(scene, format, outside)
    report = check_views(mesh, found.cameras, found.views)
    sys.stdout.write(json.dumps(report.as_dict(), indent=1) + "\n" if as_json else table(report))
    if not report.ok:
        raise InputError(report.at_command_line[1])


def table(report) -> str:
    """The report as lines of text."""
    lines = [f"{'view':<32}{'in front':>10}{'inside':>10}"]
    lines += [f"{view.name[-31:]:<32}{view.front:>10.1%}{view.inside:>10.1%}" for view in report.views]
    lines += ["", f"{'reading':<34}{'see it':>8}{'inside':>10}{'agreement':>11}{'patches':>9}"]
    for r in report.readings:
        agreement = "-" if r.agreement is None else f"{r.agreement:.3f}"
        lines.append(f"{r.name:<34}{r.seeing:>8}{r.inside:>10.1%}{agreement:>11}{r.patches:>9}")
    half_pixel, sentence = report.at_command_line
    ending = [sentence] if report.ok else []  # else it is the error's sentence, on standard error
    return "\n".join([*lines, "", half_pixel, *ending, ""])
