"""What a hard case must hold on a device.

For each case and blend: the gradient of one step against the float64 twin, everything finite, the same bits twice; then
a few steps: finite, inputs without a surface stay so, fixed pixels keep their bits.
"""

from dataclasses import dataclass, replace

import numpy as np
from support.hard_scenes import HardScene
from support.hard_table import Case, config_of
from twins.photo_loss import Photo, photo_loss, state_of
from twins.project import normalized_depth

from pagas_cl.app import device_check
from pagas_cl.app.device_check import STEPS, depth_threshold, difference, refinement_faults
from pagas_cl.config import Config
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels, relit_views
from pagas_cl.scene.depthmap import REFINED, surface_depth


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
    at = changed(initial, case.noise)
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


def changed(initial, noise: float) -> np.ndarray:
    """The depth where the gradient is compared, float32: `noise` is a share of each initial depth."""
    rng = np.random.default_rng(3)
    return np.where(initial > 0, initial * (1 + noise * rng.standard_normal(initial.shape)), 0).astype(np.float32)


def normalized(scene: HardScene):
    """Initial depth (H, W) in units of its median, 0 where there is none, and that median, scene units."""
    return normalized_depth(scene.depth, scene.target.load_mask())


def device_gradient(scene: HardScene, config: Config, device, initial, at, scene_scale):
    """As device_check.device_gradient, of a scene."""
    return device_check.device_gradient(scene.target, scene.contexts, config, device, initial, at, scene_scale)


def repeated_gradient(scene: HardScene, config: Config, device, initial, at, scene_scale):
    """As device_check.repeated_gradient, of a scene."""
    return device_check.repeated_gradient(scene.target, scene.contexts, config, device, initial, at, scene_scale)


def twin_gradient(scene: HardScene, config: Config, initial, at, scene_scale, more: float = 0.0):
    """The same gradient and loss by the float64 twin; the depth threshold larger by `more`."""
    target, contexts = Photo.from_view(scene.target), [Photo.from_view(v) for v in scene.contexts]
    state = state_of(initial.astype(np.float64), target, contexts, config, scene_scale,
                     depth_threshold(initial, config) + more)
    value, gradient = photo_loss(at.astype(np.float64), target, contexts, config, state)
    return gradient, value


def given_surface(scene: HardScene):
    """The initial depth as float32, as a refinement gives back what it leaves, and where it is a surface."""
    given = surface_depth(np.asarray(scene.depth))
    return given, given > 0


def _refinement_faults(case: Case, config: Config, scene: HardScene, device) -> list[str]:
    """A few steps of a whole refinement, twice."""
    steps = {key: value for key, value in STEPS.items() if key not in case.settings}
    results = [_refined(scene, config.with_settings(**steps), device) for _ in range(2)]
    moved = ["a pixel without parallax moved"] if case.still and (results[0].status == REFINED).any() else []
    return refinement_faults(scene.depth, results) + moved


def _refined(scene: HardScene, config: Config, device):
    given = ViewInput(scene.target, scene.contexts, scene.depth, device, PhotoStore(device))
    if config.loss.shading:
        given = replace(given, contexts=relit_views(given, config))
    return refine_levels(given, config)
