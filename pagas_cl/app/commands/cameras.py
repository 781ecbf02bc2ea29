"""`pagas-cl cameras`: refine the cameras of a scene by its photos and a first surface; for other tools, too."""

import sys
from pathlib import Path

import numpy as np
import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import look, place_of
from pagas_cl.app.commands._outputs import check_outputs
from pagas_cl.app.commands._process import shown_progress, typed
from pagas_cl.errors import InputError, plain
from pagas_cl.jobs.work_folder import one_run
from pagas_cl.method.cameras.model import REPORT, check_place, write_model
from pagas_cl.refine import refine_cameras
from pagas_cl.scene.lens import ThroughLens
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.own_files import write_json


def command(
    scene: Path = options.SCENE,
    mesh: Path = typer.Option(None, "--mesh", help="The surface; it stays where it is."),
    depth_dir: Path = options.DEPTH_DIR,
    output: Path = typer.Option(..., "--output", help="Folder for sparse/0 (a COLMAP model) and cameras_report.json."),
    unknowns: list[str] = typer.Option([], "--unknowns", metavar="NAME",
                                       help="pose (default), focal, principal_point, depth_scale, depth_shift."),
    device: str = options.DEVICE,
    devices: str = options.DEVICES,
    scheduler: str = options.SCHEDULER,
    format: str = options.FORMAT,
    photos: Path = options.PHOTOS,
    depth_scale: float = options.DEPTH_SCALE,
    outside: bool = options.OUTSIDE,
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Refine the cameras of SCENE, so that its photos agree through the surface.

    They stay as they are, with the reason, where pairs of photos that take no part do not agree better.
    """
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos)
    found = given.scene
    given.file_stems()
    check_outputs([("the report of --output", output / REPORT)], [("--output", output)], given.inputs, overwrite)
    given.log()
    check_place(output, found.views, overwrite)
    lenses = bool({"focal", "principal_point"} & set(unknowns))
    bent = [view.name for view in found.views if lenses and isinstance(view.image, ThroughLens)]
    if bent:
        raise InputError(f"--unknowns: the photo of view {bent[0]!r} is distorted, and a lens with other numbers would "
                         "undistort it otherwise; undistort first: colmap image_undistorter")
    place = place_of(device, devices, scheduler)
    progress = shown_progress(quiet)
    with one_run(output):
        surface = given.initial_depths(progress) if given.mesh is None else to_surface(given.mesh)
        refined = refine_cameras(found.views, surface, unknowns=tuple(unknowns) or ("pose",), folder=output,
                              progress=progress, **place)
        model = write_model(scene, found.views, refined.cameras, output)
        write_json(output / REPORT, "cameras", {"model": sorted(file.name for file in model.iterdir()),
                                                **refined.as_dict()})
    sys.stdout.write(table(refined, [view.name for view in found.views]))
    sys.stdout.write(_closing(refined, scene, output if lenses else None, model, given.read | {"--mesh": given.mesh}))


def _closing(refined, scene: Path, new: Path | None, model: Path, read: dict[str, Path | None]) -> str:
    """What was written, and the command that goes on from here; `new`: the scene to go on with, since `refine` by
    itself leaves lenses alone; `read`: what was read, by its option."""
    place = new if new and refined.accepted else scene
    given = [str(word) for option in ("--mesh", "--depth-dir", "--photos") if read[option] is not None
             for word in (option, read[option])]
    command_line = ["pagas-cl", "refine", str(place), *given, "--output", "fine.ply"]
    if place is new:
        return (f"the refined cameras are in {str(model)!r}; 'pagas-cl refine' by itself refines poses alone, so put "
                f"SCENE's photos (and masks) next to them: {str(place / 'images')!r}. Next: {typed(command_line)}\n")
    if refined.accepted:
        return (f"the refined cameras are in {str(model)!r}, for other programs; 'pagas-cl refine' refines those of "
                f"SCENE itself while it works. Next: {typed(command_line)}\n")
    return (f"the model in {str(model)!r} has the cameras as SCENE has them: nothing was gained by moving them. Next: "
            f"{typed([*command_line, '--effect', 'cameras=off'])}\n")


def table(refined, names) -> str:
    moved = "moved, pixels" if refined.accepted else "tried, pixels"
    lines = [f"{'view':<40}{moved:>15}"]
    numbers = ["-" if np.isnan(moved) else f"{moved:.3f}" for moved in refined.moved]
    lines += [f"{name[-39:]:<40}{number:>15}{'  wrong, left out' if name in refined.left_out else ''}"
              for name, number in zip(names, numbers)]
    lines += ["", f"{'pair that took no part':<60}{'cost before':>12}{'after':>9}"] if refined.pairs else []
    lines += [f"{f'{one}, {other}'[-59:]:<60}{before:>12.4f}{after:>9.4f}"
              for one, other, before, after in refined.pairs]
    return "\n".join(map(plain, [*lines, "", str(refined), ""]))
