"""What commands do before the work: read the scene and the initial depth of its views, say what is kept of them."""

from contextlib import contextmanager
from pathlib import Path

from pagas_cl.app.commands._process import opened_device
from pagas_cl.errors import InputError, InterruptedRunError, log
from pagas_cl.jobs.executors import check_address
from pagas_cl.jobs.finished import begun_in, records_in
from pagas_cl.jobs.work_folder import forget_inputs
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.depthmap import find_depths
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.meshes.files import read_content
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import Scene


def check_source(mesh, other, what: str, outside: bool, option: str = "--depth-dir") -> None:
    """Raise InputError unless exactly one of both is given, `what` says in the message what they are for, and the mesh
    can be read, files that it names among it; a mesh with a project is for pymeshlab, which has its own check."""
    if (mesh is None) == (other is None):
        raise InputError(f"expected either --mesh or {option} ({what}), got {'neither' if mesh is None else 'both'}")
    if mesh is not None and option != "--project":
        read_content(mesh, outside=outside)


def place_of(device, devices, scheduler) -> dict:
    """Where the work is done, as refine_views takes it."""
    if device is not None and devices is not None:
        raise InputError("got both --device and --devices, expected one of them")
    several = "all" if devices == "all" else devices.split(",") if devices else None
    if scheduler is not None:
        check_address(scheduler)
        return {"executor": scheduler, "device": several or device}
    return {"device": several or opened_device(device)}


def load_scene(scene: Path, format: str | None, outside: bool, photos: Path | None = None) -> Scene:
    """The scene in a folder; options that its reader does not have are refused by name."""
    options = {**({"outside": True} if outside else {}), **({} if photos is None else {"photos": photos})}
    try:
        return read_scene(scene, format, **options)
    except TypeError as error:
        option = next((name for name in options if f"'{name}'" in str(error)), None)
        if option is None:
            raise
        raise InputError(f"--{option} does not go with the format of {str(scene)!r}") from error


@contextmanager
def resumable(folder: Path | None, total: int):
    """Context, inside one_run, of a run of `total` views that keeps finished ones in `folder`: says first what an
    earlier run has left there, and where it is interrupted (InterruptedRunError) what is kept now, and how to go on.
    Where no view was finished nothing stays of what was drawn."""
    def found() -> tuple[int, str]:
        """How many views are kept, and as what: those of the last round, or else of earlier ones."""
        done = len(records_in(folder)) if folder is not None else 0
        return (done, "finished") if done or folder is None else (begun_in(folder), "begun")

    left, how = found()
    if left:
        log.info("an earlier run has left %d %s view%s in %s: what would come out the same is not done again",
                 left, how, "" if left == 1 else "s", folder)
    try:
        yield
    except InputError:
        if not found()[0]:
            forget_inputs(folder)
        raise
    except KeyboardInterrupt as error:
        done, how = found()
        if not done:
            forget_inputs(folder)
        what = (f"{done} of {total} views are {how} and kept in {str(folder)!r}: the same command goes on from them"
                if done else "nothing is kept, no view was finished" if folder is not None
                else "nothing is kept but pictures; with --save-depth finished views are")
        raise InterruptedRunError(f"interrupted; {what}") from error


def initial_depths(found, mesh, depth_dir, depth_scale, progress, names=None) -> list:
    """Initial depth of every view, from the mesh or from files; None for a view without a file, which `names` must
    have."""
    if mesh is not None:
        from pagas_cl import refine

        return refine.initial_depths(to_surface(mesh), found.views, progress)
    return loaded(depth_files(found, depth_dir, depth_scale, names, as_numbers=False)[0])


def loaded(depths) -> list:
    """The depth maps themselves, for what loads them."""
    return [None if depth is None else depth_array(depth) for depth in depths]


def depth_files(found, depth_dir, depth_scale, names=None, as_numbers: bool = True) -> tuple[list, bool]:
    """What loads the depth map of every view from `depth_dir`, None for a view without a file, and whether all files
    say their unit. A PNG does not: without a scale its numbers are taken as they are, or refused where `as_numbers` is
    false."""
    files = find_depths(depth_dir, [view.name for view in found.views])
    if not any(files):
        raise InputError(f"--depth-dir {str(depth_dir)!r} holds no depth map of the scene's {len(files)} views, "
                         f"expected for instance {found.views[0].stem}.npz")
    without = [view for view, file in zip(found.views, files) if file is None]
    requested = [view for view in without if names and view.name in names]
    if requested:
        raise InputError(f"--depth-dir {str(depth_dir)!r} holds no depth map of the view {requested[0].name!r}, which"
                         f" is to be refined, expected for instance {requested[0].stem}.npz")
    if without and not names:
        log.warning("%d views have no depth map in %s: they help to refine others, but are not refined: %s",
                    len(without), depth_dir,
                    ", ".join(view.name for view in without[:10]) + (", ..." if len(without) > 10 else ""))
    without_unit = next((file for file in files if file and file.suffix.lower() == ".png"), None)
    said = depth_scale is not None or without_unit is None
    if not (said or as_numbers):
        raise InputError(f"depth map {str(without_unit)!r}: a PNG does not say its unit; give --depth-scale (1000 for "
                         "millimetres in a scene of metres)")
    scale = 1.0 if depth_scale is None else depth_scale
    sources = [file and DepthSource(file.resolve(), (view.camera.width, view.camera.height), scale)
               for view, file in zip(found.views, files)]
    return sources, said
