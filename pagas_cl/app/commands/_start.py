"""What commands do before the work: say where it is done, read the scene, say what an earlier run has left."""

from contextlib import contextmanager
from pathlib import Path

from pagas_cl.app.commands._process import opened_device
from pagas_cl.errors import InputError, InterruptedRunError, log
from pagas_cl.jobs.finished import begun_in, records_in
from pagas_cl.jobs.work_folder import forget_inputs
from pagas_cl.jobs.worker import check_address
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import Scene


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


def loaded(depths) -> list:
    """The depth maps themselves, for what loads them."""
    return [None if depth is None else depth_array(depth) for depth in depths]
