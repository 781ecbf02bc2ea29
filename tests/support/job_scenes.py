"""A small scene on disk for the tests of many views, and work that can be slow, fail, or kill its worker.

Functions at the top of a module, so that other processes find them.
"""

import os
import signal
import time
from pathlib import Path

import numpy as np
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.config.presets import preset
from pagas_cl.errors import DeviceLostError
from pagas_cl.method.effects.decide import EFFECTS
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import find_depth, load_depth
from pagas_cl.scene.readers import read_scene

TESTS = Path(__file__).resolve().parents[1]
# cameras off: whether a scene calls for them is measured before any job; agreement off: one round, whose files are
# final as they come (more of them: tests/surface/test_agreement.py, and what kill_trials.py kills); the others as the
# preset has them: to measure what a view calls for takes longer than so small a view's refinement. NOT_MEASURED: the
# same on the command line, where depth maps are not brought together, either
NOT_MEASURED = ["--no-align", "--effect", "cameras=off", *(f"{name}=set" for name in (*EFFECTS, "pyramid"))]
QUICK = preset("balanced").with_settings(
    pyramid__steps=(3,), context__number=3, effects__cameras="off", effects__agreement="off",
    **{f"effects__{name}": "set" for name in (*EFFECTS, "pyramid")})


def write_small_scene(folder, views=8) -> Path:
    """`views` photos of 64 x 48 pixels with cameras, a coarse mesh and initial depth maps."""
    return write_scene(relief_scene(64, 48, views - 1, held_out=0), folder)


def load_small_scene(folder):
    """Views (photos on disk) and initial depth maps."""
    scene = read_scene(folder)
    return scene.views, [load_depth(find_depth(folder / "depth_initial", view.name)) for view in scene.views]


def compile_once(folder, config=QUICK) -> None:
    """Refine a view here, so that several processes find its kernels compiled and do not each compile them."""
    views, depths = load_small_scene(folder)
    refine_views(views, depths, names=[views[0].name], config=config)


def bytes_of(folder) -> dict:
    """Content of every depth map in a folder of results."""
    return {path.name: path.read_bytes() for path in sorted(Path(folder).glob("*.npz"))}


def said(folder, what: str) -> list[str]:
    """Names of the views that workers have written `what` ("began", "ended", "failed") of, in their journals."""
    lines = [line.split(" ", 2) for path in sorted((Path(folder) / ".pagas_cl" / "journal").glob("*.txt"))
             for line in path.read_text().splitlines()]
    return [name for _, word, name in lines if word == what]


# -- work ----------------------------------------------------------------------------------------------------------


def copy_depth(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """No refinement at all: the depth as it came."""
    return DepthResult.unrefined(views[partners.target].camera, depth, "copied")


def slow_refine(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """The real refinement, half a second later."""
    time.sleep(0.5)
    return refine_one(views, partners, depth, config, device, photos)


def killed_once(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """Kills its process at the third view, the first time."""
    path = Path(os.environ["PAGAS_CL_TEST_MARK"])
    if partners.target == 2 and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return copy_depth(views, partners, depth, config, device, photos)


def killed_always(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """Kills its process at the third view."""
    if partners.target == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return copy_depth(views, partners, depth, config, device, photos)


def lost_once(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """Loses its device at the second view, the first time."""
    path = Path(os.environ["PAGAS_CL_TEST_MARK"])
    if partners.target == 1 and not path.exists():
        path.touch()
        raise DeviceLostError("the device is gone")
    return copy_depth(views, partners, depth, config, device, photos)


def fails_always(views, partners, depth, config, device, photos, on_step=None) -> DepthResult:
    """Fails at the second view."""
    if partners.target == 1:
        raise np.linalg.LinAlgError("never")
    return copy_depth(views, partners, depth, config, device, photos)


def waits(seconds, worker) -> None:
    """Not a view but a part of other work: nothing, for so long."""
    time.sleep(seconds)
