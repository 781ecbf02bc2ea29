"""`pagas-cl cameras`: refine the cameras of a scene by its photos and a first surface; for other tools, too."""

import json
import sys
from pathlib import Path

import typer

from pagas_cl.cameras.model import REPORT, check_place, write_model
from pagas_cl.cameras.refine import refine_cameras
from pagas_cl.commands._console import shown_progress
from pagas_cl.commands._start import check_source, check_writable, initial_depths, load_scene, place_of
from pagas_cl.errors import log, plain
from pagas_cl.jobs.finished import one_run
from pagas_cl.scene.files import write_text
from pagas_cl.scene.mesh import to_surface

MANY = ("--unknowns",)


def command(
    scene: Path = typer.Argument(..., metavar="SCENE", help="Folder with images/ and cameras (sparse/0, ...)."),
    mesh: Path = typer.Option(None, "--mesh", help="The surface; it stays where it is."),
    depth_dir: Path = typer.Option(None, "--depth-dir", help="Depth maps, <image stem>.npz, not --mesh."),
    output: Path = typer.Option(..., "--output", help="Folder for sparse/0 (a COLMAP model) and cameras_report.json."),
    unknowns: list[str] = typer.Option([], "--unknowns", metavar="NAME",
                                       help="pose (default), focal, principal_point, depth_scale, depth_shift."),
    device: str = typer.Option(None, "--device", help="Part of an OpenCL device's name; see 'pagas-cl devices'."),
    devices: str = typer.Option(None, "--devices", metavar="all|NAME,...", help="A process on each of these devices."),
    scheduler: str = typer.Option(None, "--scheduler", metavar="tcp://HOST:PORT", help="A Dask cluster you trust."),
    format: str = typer.Option(None, "--format", help="Format of SCENE, where looking at it is not enough."),
    depth_scale: float = typer.Option(None, "--depth-scale", help="Number for one scene unit in the depth files."),
    outside: bool = typer.Option(False, "--outside", help="Allow files outside SCENE (scenes that you trust)."),
    quiet: bool = typer.Option(False, "--quiet", help="No progress."),
):
    """Refine the cameras of SCENE, so that its photos agree through the surface.

    They stay as they are, with the reason, where pairs of photos that take no part do not agree better.
    """
    check_source(mesh, depth_dir, "the surface that photos are compared through", outside)
    found = load_scene(scene, format, outside)
    for view in found.views:
        view.check_files()
    check_writable("--output", output)
    check_place(output, found.views)
    place = place_of(device, devices, scheduler)
    with shown_progress(quiet) as progress, one_run(output):
        surface = (to_surface(mesh) if mesh is not None
                   else initial_depths(found, mesh, depth_dir, depth_scale, progress))
        told = refine_cameras(found.views, surface, unknowns=tuple(unknowns) or ("pose",), folder=output,
                              progress=progress, **place)
        write_text(output / REPORT, json.dumps(told.as_dict(), indent=1) + "\n")
        model = write_model(scene, found.views, told.cameras, output)
    sys.stdout.write(table(told, [view.name for view in found.views]))
    log.info("the refined cameras, for COLMAP and others: %s", model)


def table(told, names) -> str:
    """What moved, and what speaks for it, as lines of text."""
    lines = [f"{'view':<40}{'moved, pixels':>15}"]
    lines += [f"{name[-39:]:<40}{moved:>15.3f}{'  wrong, left out' if name in told.left_out else ''}"
              for name, moved in zip(names, told.moved)]
    lines += ["", f"{'pair that took no part':<60}{'cost before':>12}{'after':>9}"] if told.pairs else []
    lines += [f"{f'{one}, {other}'[-59:]:<60}{before:>12.4f}{after:>9.4f}" for one, other, before, after in told.pairs]
    return "\n".join(map(plain, [*lines, "", str(told), ""]))
