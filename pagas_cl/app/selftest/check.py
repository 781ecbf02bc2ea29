"""What a hard case must hold on a device.

For each case and blend: the gradient of one step against the float64 twin in pagas_cl.method.reference, everything
finite, the same bits twice; then a few steps: finite, inputs without a surface stay so, fixed pixels keep their bits.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.app.selftest.scenes import HardScene
from pagas_cl.app.selftest.table import CASES, Case, config_of
from pagas_cl.config import Config
from pagas_cl.method.reference.level import Photo, photo_loss, state_of
from pagas_cl.method.reference.project import normalized_depth
from pagas_cl.method.splat import PhotoStore, refine_levels, relit_views
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.level import Level, Phase
from pagas_cl.method.splat.step import loss_of
from pagas_cl.scene.depthmap import NO_SURFACE, REFINED, surface_depth

STEPS = dict(smoothness__kind="planar", smoothness__weight=0.12, pyramid__scales=(1.0,), pyramid__steps=(3,))
DAMPED = 1e-3             # gradient per pixel of parallax below which the solver hardly moves: a floor


@dataclass(frozen=True)
class Outcome:
    """What a case came to: the worst figure against its tolerance, and what is wrong (empty where nothing is)."""

    case: Case
    blend: str
    worst: float
    faults: tuple[str, ...]

    @property
    def ok(self) -> bool:
        return not self.faults


def run_case(case: Case, blend: str, device) -> Outcome:
    """Run one case on an open device."""
    scene, config = case.scene(), config_of(case, blend)
    initial, scene_scale = normalized(scene)
    rng = np.random.default_rng(3)
    at = np.where(initial > 0, initial * (1 + case.noise * rng.standard_normal(initial.shape)), 0).astype(np.float32)
    got, length, faults = repeated_gradient(scene, config, device, initial, at, scene_scale)
    if not case.still and not (length > 0).any():
        faults.append("no pixel is seen with parallax: the case shows nothing")
    worst = 0.0
    if (initial > 0).any():
        want, _ = twin_gradient(scene, config, initial, at, scene_scale)
        worst = difference(got, want, length)
        if not worst <= case.tolerance:
            faults.append(f"gradient differs from the twin by {worst:.3g}")
    if (got[initial == 0] != 0).any():
        faults.append("a gradient where there is no surface")
    return Outcome(case, blend, worst, tuple(faults + _refinement_faults(case, config, scene, device)))


def repeated_gradient(scene: HardScene, config: Config, device, initial, at, scene_scale):
    """Gradient and depth of a pixel of parallax as by device_gradient, and what is wrong with them by themselves."""
    got, loss, length = device_gradient(scene, config, device, initial, at, scene_scale)
    again, loss_again, _ = device_gradient(scene, config, device, initial, at, scene_scale)
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


def normalized(scene: HardScene):
    """Initial depth (H, W) in units of its median, 0 where there is none, and that median, scene units."""
    return normalized_depth(scene.depth, scene.target.load_mask())


def _depth_threshold(initial, config: Config) -> float:
    d = initial[initial > 0].astype(np.float64)
    return float(d.max() - d.min()) / config.splatting.depth_slices if d.size else 0.0


def device_gradient(scene: HardScene, config: Config, device, initial, at, scene_scale):
    """N dL/dd (H, W), not filtered, and L of the depth `at` on the device, and the depth of a pixel of parallax (H, W);
    all in units of `scene_scale`."""
    config = config.with_settings(solver__gradient_filter=0)
    photos, views = PhotoStore(device), [scene.target, *scene.contexts]
    level = Level(device, config, LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene_scale,
                                             _depth_threshold(initial, config), 1.0, len(scene.contexts)))
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


def twin_gradient(scene: HardScene, config: Config, initial, at, scene_scale, more: float = 0.0):
    """The same gradient and loss by the float64 twin; the depth threshold larger by `more`."""
    target, contexts = Photo.from_view(scene.target), [Photo.from_view(v) for v in scene.contexts]
    state = state_of(initial.astype(np.float64), target, contexts, config, scene_scale,
                     _depth_threshold(initial, config) + more)
    value, gradient = photo_loss(at.astype(np.float64), target, contexts, config, state)
    return gradient, value


def given_surface(scene: HardScene):
    """The initial depth as float32, as a refinement gives back what it leaves, and where it is a surface."""
    given = surface_depth(np.asarray(scene.depth))
    return given, given > 0


def _refinement_faults(case: Case, config: Config, scene: HardScene, device) -> list[str]:
    """A few steps of a whole refinement, twice."""
    steps = {key: value for key, value in STEPS.items() if key not in case.settings}
    config = config.with_settings(**steps)
    first, second = (_refined(scene, config, device) for _ in range(2))
    given, surface = given_surface(scene)
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
        "a pixel without parallax moved": case.still and (first.status == REFINED).any(),
    }
    return [fault for fault, found in faults.items() if found]


def _refined(scene: HardScene, config: Config, device):
    photos, contexts = PhotoStore(device), scene.contexts
    if config.loss.shading:
        contexts = relit_views(scene.target, contexts, scene.depth, config, device, photos)
    return refine_levels(scene.target, contexts, scene.depth, config, device, photos)


def run_all(device) -> Iterator[Outcome]:
    """Every case with each of its blends, in order, as they come."""
    return (run_case(case, blend, device) for case in CASES for blend in case.blends)
