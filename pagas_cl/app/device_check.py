"""Whether a device computes as it should: one step against a recorded gradient, and a refinement, each of them twice.

recorded_step.npz holds a small scene and the gradients of one step there, made by the float64 twins of the kernels
(tests/support/recorded_step.py writes it; a test holds it against the twins).

A child process tries a device so, and then with a whole view:

    python -m pagas_cl.app.device_check '{"identity": [...], "lanes": 16}'

answers with one line of JSON: {"fault": "", "lasting": true}. `lasting` is false for what another try may mend.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.config.presets import BALANCED, PAPER
from pagas_cl.errors import DeviceError, KernelBuildError
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.level import Level, Phase
from pagas_cl.method.splat.step import loss_of
from pagas_cl.method.splat.view import Refinement
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.result import DepthResult
from pagas_cl.runtime import device as devices
from pagas_cl.runtime import trial
from pagas_cl.runtime.listing import find_devices
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import NO_SURFACE, REFINED, surface_depth
from pagas_cl.scene.view import View
from pagas_cl.system import child

PLAIN = dict(smoothness__kind="none", smoothness__weight=0.0, solver__views_per_step=0, solver__patience=5)
ORDER_FREE, ALPHA = BALANCED.with_settings(**PLAIN), PAPER.with_settings(solver__patience=5)
SETTINGS = {"order-free blend": ORDER_FREE.with_settings(loss__exposure=True),
            "alpha blend": ALPHA.with_settings(loss__exposure=True),
            "order-free blend, grey": ORDER_FREE.with_settings(loss__grey=True)}
STEPS = dict(smoothness__kind="planar", smoothness__weight=0.12, pyramid__scales=(1.0,), pyramid__steps=(3,))
TOLERANCE = 1e-3          # most |device - recorded| / |recorded| of a gradient
DAMPED = 1e-3             # gradient per pixel of parallax below which the solver hardly moves: a floor


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """A scene in the target's median depths: `initial` and `at`, where the gradient is taken, are float32 (H, W),
    0 = no surface; `gradients` are those of SETTINGS, float32 (H, W)."""

    target: View
    contexts: list[View]
    scene_scale: float
    initial: np.ndarray
    at: np.ndarray
    gradients: dict[str, np.ndarray]

    @classmethod
    def load(cls) -> "RecordedStep":
        """The one that ships with the package."""
        with files("pagas_cl.app").joinpath("recorded_step.npz").open("rb") as file, np.load(file) as held:
            photos, poses, numbers = held["photos"], held["poses"], held["intrinsics"]
            views = []
            for photo, pose, (fx, fy, cx, cy) in zip(photos, poses, numbers.tolist()):
                height, width = photo.shape[:2]
                views.append(View(Camera(width, height, fx, fy, cx, cy, pose), photo))
            return cls(views[0], views[1:], float(held["scene_scale"]), held["initial"], held["at"],
                       dict(zip(SETTINGS, held["gradients"])))


@dataclass(frozen=True)
class Outcome:
    """What one of SETTINGS came to: the gradient's difference, and what is wrong (empty where nothing is)."""

    name: str
    worst: float
    faults: tuple[str, ...]


def outcomes(device) -> Iterator[Outcome]:
    """Of each of SETTINGS, in order, as they come."""
    step = RecordedStep.load()
    for name, config in SETTINGS.items():
        got, length, faults = repeated_gradient(step.target, step.contexts, config, device, step.initial, step.at,
                                                step.scene_scale)
        worst = difference(got, step.gradients[name], length)
        if not worst <= TOLERANCE:
            faults.append(f"gradient differs from the recorded one by {worst:.3g}")
        depth = step.initial * np.float32(step.scene_scale)
        faults += refinement_faults(depth, [
            refine_levels(ViewInput(step.target, step.contexts, depth, device, PhotoStore(device)),
                          config.with_settings(**STEPS))
            for _ in range(2)])
        yield Outcome(name, worst, tuple(faults))


def device_gradient(target: View, contexts: list[View], config: Config, device, initial, at, scene_scale: float):
    """N dL/dd (H, W), not filtered, and L of the depth `at` on the device, and the depth of a pixel of parallax (H, W);
    all in units of `scene_scale`."""
    config = config.with_settings(solver__gradient_filter=0)
    photos, views = PhotoStore(device), [target, *contexts]
    level = Level(device, config, LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene_scale,
                                             depth_threshold(initial, config), 1.0, len(contexts)))
    cl.enqueue_copy(device.queue, level.buffers.depth, initial)
    level.prepare()
    level.start()
    level.enter(Phase(config, raised=True))
    cl.enqueue_copy(device.queue, level.buffers.depth, at)
    for launch in level.step_launches(0):
        launch.enqueue(device.queue)
    found = level.gradient(), loss_of(device, level.buffers), level.read("depth_per_parallax", at.shape)
    level.release()
    return found


def depth_threshold(initial, config: Config) -> float:
    """The range of the initial depth by the slices of the settings (method section 3), 0 without a surface."""
    d = initial[initial > 0].astype(np.float64)
    return float(d.max() - d.min()) / config.splatting.depth_slices if d.size else 0.0


def repeated_gradient(target: View, contexts: list[View], config: Config, device, initial, at, scene_scale: float):
    """Gradient and depth of a pixel of parallax as by device_gradient, and what is wrong with them by themselves."""
    got, loss, length = device_gradient(target, contexts, config, device, initial, at, scene_scale)
    again, loss_again, _ = device_gradient(target, contexts, config, device, initial, at, scene_scale)
    faults = []
    if got.tobytes() != again.tobytes() or loss != loss_again:
        faults.append("a second run gives other bits")
    if not (np.isfinite(got).all() and np.isfinite(loss)):
        faults.append(f"{np.count_nonzero(~np.isfinite(got))} gradients are not finite, the loss is {loss:g}")
    return got, length, faults


def difference(got, want, length) -> float:
    """|got - want| / |want|, the latter at least DAMPED per pixel of parallax; fixed pixels count in neither."""
    free = length > 0
    if not free.any():
        return 0.0
    got, want, length = got[free].astype(np.float64), want[free], length[free]
    return float(np.linalg.norm(got - want) / max(np.linalg.norm(want), np.linalg.norm(DAMPED / length)))


def refinement_faults(depth, results: Sequence[Refinement | DepthResult]) -> list[str]:
    """What is wrong with two results of one refinement of `depth` (H, W), 0 = no surface."""
    first, second = results
    given = surface_depth(np.asarray(depth))
    surface = given > 0
    kept = surface & (first.status != REFINED)
    faults = {f"a second refinement gives another {name}": getattr(first, name).tobytes()
              != getattr(second, name).tobytes() for name in ("depth", "status", "deviation", "parallax")}
    faults |= {
        "the refined depth is not finite": not np.isfinite(first.depth).all() or np.isnan(first.deviation).any()
        or np.isnan(first.parallax).any(),
        "the refinement made or removed a surface": ((first.status != NO_SURFACE) != surface).any(),
        "a refined depth is not above 0, or one without a surface is not 0":
            (first.depth[surface] <= 0).any() or first.depth[~surface].any(),
        "a pixel that was not refined did not keep its bits": (first.depth[kept] != given[kept]).any(),
    }
    return [fault for fault, found in faults.items() if found]


def try_out(identity: list, lanes: int) -> dict:
    """What is wrong with the device of that trial.identity, with so many lanes."""
    found = [pair for pair in find_devices(cl) if trial.identity(pair[0]) == identity]
    if not found:
        return {"fault": "it is no longer there", "lasting": False}
    try:
        device = devices.opened(*found[0], lanes)
        for outcome in outcomes(device):
            if outcome.faults:
                return {"fault": f"it computes wrongly ({outcome.name}: {'; '.join(outcome.faults)})", "lasting": True}
        step = RecordedStep.load()      # a view refined as users do, its effects measured; programs are compiled by now
        config = SETTINGS["order-free blend"].with_settings(**STEPS, effects__exposure="on")
        depth = step.initial * np.float32(step.scene_scale)
        result = refine_depth(step.target, step.contexts, depth, config=config, device=device)
        fault = "" if np.isfinite(result.depth).all() else "it computes wrongly (a refined depth is not finite)"
        return {"fault": fault, "lasting": True}
    except KernelBuildError as error:
        return {"fault": f"its compiler fails ({error})", "lasting": True}
    except (cl.Error, DeviceError) as error:
        return {"fault": f"it fails ({devices.cause(error)})", "lasting": False}


if __name__ == "__main__":
    child.answer(try_out)
