"""`pagas-cl check`: are these the right cameras for this mesh and these photos?"""

import re
import sys
from dataclasses import replace
from pathlib import Path

import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import look, together
from pagas_cl.errors import InputError, plain
from pagas_cl.scene.check.cameras import CameraReport, check_views
from pagas_cl.scene.check.fit import GOOD
from pagas_cl.scene.check.reasons import likely_reasons, mesh_of_depths
from pagas_cl.scene.own_files import json_text
from pagas_cl.scene.view import View


def command(
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with photos and cameras, in any supported format."),
    mesh: Path = typer.Option(None, "--mesh", help="The mesh that the cameras should see. Without it: SCENE's depth."),
    depth_dir: Path = options.DEPTH_DIR,
    depth_scale: float = options.DEPTH_SCALE,
    format: str = options.FORMAT,
    outside: bool = options.OUTSIDE,
    photos: Path = options.PHOTOS,
    as_json: bool = typer.Option(False, "--json", help="Print everything as JSON."),
    quiet: bool = options.QUIET,
):
    """Check the cameras of SCENE against a mesh, or its depth maps, and the photos.

    Estimates the offset and scale of the mesh that would make the photos agree, too. Status 2 when another reading of
    the cameras fits better, when none sees the mesh, or when mesh and cameras are pixels of parallax apart.
    """
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos)
    given.log()
    given.file_stems()
    views = given.scene.views
    report = (check_views(given.mesh, given.scene.cameras, views) if given.mesh is not None
              else check_depth_maps(views, together(given, True)))
    sys.stdout.write(json_text("check", report.as_dict()) if as_json else table(report))
    if not report.ok:
        raise InputError(report.at_command_line[1])


def check_depth_maps(views: list[View], depths: list) -> CameraReport:
    """The report on the surface that depth maps show, in words of these. They move with the cameras, as a mesh does
    not: where photos do not agree over them as given, the likeliest reason is looked for with maps that do."""
    cameras = [view.camera for view in views]
    report = check_views(mesh_of_depths(cameras, depths), cameras, views)
    half_pixel, sentence, *at_command_line = (
        re.sub(r"\bmesh\b", "depth maps", sentence.replace("the mesh", "the surface of the depth maps"))
        for sentence in (report.half_pixel, report.sentence, *report.at_command_line))
    report = replace(report, half_pixel=half_pixel, sentence=sentence, at_command_line=tuple(at_command_line))
    reasons = likely_reasons(views, depths) if (report.readings[0].agreement or 0) < GOOD else []
    if not reasons:
        return report
    return replace(report, ok=False, sentence=reasons[0], at_command_line=(report.at_command_line[0], reasons[0]))


def table(report) -> str:
    lines = [f"{'view':<32}{'in front':>10}{'inside':>10}"]
    lines += [f"{view.name[-31:]:<32}{view.front:>10.1%}{view.inside:>10.1%}" for view in report.views]
    lines += ["", f"{'reading':<42}{'see it':>8}{'inside':>10}{'agreement':>11}{'patches':>9}"]
    for r in report.readings:
        agreement = "-" if r.agreement is None else f"{r.agreement:.3f}"
        lines.append(f"{r.name:<42}{r.seeing:>8}{r.inside:>10.1%}{agreement:>11}{r.patches:>9}")
    half_pixel, sentence = report.at_command_line
    ending = [sentence] if report.ok else []  # else it is the error's sentence, on standard error
    return "\n".join(map(plain, [*lines, "", half_pixel, *ending, ""]))
