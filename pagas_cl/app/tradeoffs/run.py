"""One setting on one case: the refined depth, its time and its memory; and how long that will take."""

import time
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.random import default_rng  # while it is imported it swallows Ctrl-C: before the run, not in it

from pagas_cl.app.tradeoffs.case import BenchmarkCase
from pagas_cl.app.tradeoffs.costs import photo_seconds, probe, view_steps
from pagas_cl.app.tradeoffs.plan import OWN_ERROR, RANDOM, Setting
from pagas_cl.config.presets import preset
from pagas_cl.method.effects.decide import resolve_effects
from pagas_cl.method.splat import refine_levels
from pagas_cl.method.surface.agree import counts
from pagas_cl.scene.depthmap import depth_up


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one run gives.

    `seconds`, the median of the repeats, are from photos on the device to the depth on the host, the measuring of
    effects included, compiling not.
    """

    depth: np.ndarray    # (H, W), float32
    seconds: float
    view_steps: float    # full-size steps times context views that were done
    device_bytes: int    # most that was taken, photos included


def run(setting: Setting, case: BenchmarkCase, device, photos, repeats: int = 1) -> Outcome:
    """Run `setting` on `case`, after a run of a step a level that compiles and uploads."""
    initial = initial_depth(setting, case)
    short = [stage.with_settings(pyramid__steps=tuple(min(1, n) for n in stage.pyramid.steps))
             for stage in setting.stages]
    _stages(short, case.target, case.contexts, initial, device, photos)
    times = []
    for _ in range(max(1, repeats)):
        start = time.perf_counter()
        depth, work, most = _stages(setting.stages, case.target, case.contexts, initial, device, photos)
        if setting.agree:
            depth = _agreed(setting, case, depth, device, photos)
        times.append(time.perf_counter() - start)
    return Outcome(depth, float(np.median(times)), work * (1 + setting.agree), most)


def _stages(stages, target, contexts, depth, device, photos):
    work, most = 0.0, 0
    for stage in stages:
        used_contexts = contexts[:stage.context.number]
        with resolve_effects(target, used_contexts, depth, stage, device, photos) as (own, _, measured, used):
            found = refine_levels(target, used, depth, own, device, photos, measured=measured)
        work += view_steps(own, len(used), found.steps)
        depth, most = found.depth, max(most, found.device_bytes)
    return depth, work, most


def _agreed(setting, case, depth, device, photos):
    """The depth where enough refined context views confirm it, 0 at other pixels."""
    views = [case.target, *case.contexts]
    known = [(view, start) for view, start in zip(case.contexts, case.context_depths) if start is not None]
    cameras, others = [], []
    for view, start in known[:2 * setting.agree]:
        around = [other for other in views if other is not view]
        cameras.append(view.camera)
        others.append(_stages(setting.stages, view, around, start, device, photos)[0])
    count, _ = counts(case.target.camera, depth, cameras, others, setting.stages[-1].fusion.agree_pixels, device)
    return np.where(count >= setting.agree, depth, np.float32(0))


def initial_depth(setting: Setting, case: BenchmarkCase) -> np.ndarray:
    """The depth that `setting` starts from: the case's own, or one made from it, the same every time."""
    depth = given = np.where(np.isfinite(case.initial), case.initial, 0).astype(np.float32)
    rng = default_rng(crc32(case.name.encode("utf-8", "surrogatepass")))
    valid = given > 0
    if setting.initial == RANDOM:
        depth = rng.uniform(float(given[valid].min()), float(given[valid].max()), given.shape)
    elif setting.initial == OWN_ERROR:
        depth = np.maximum(given + 0.5 * case.parallax * _smooth_noise(rng, given.shape, 40), 0)
    return np.where(valid, depth, 0).astype(np.float32)


def _smooth_noise(rng, shape, wavelength: int) -> np.ndarray:
    """Noise of mean absolute value 1 that changes over `wavelength` pixels, float64 (H, W)."""
    coarse = rng.uniform(1.0, 3.0, [max(2, n // wavelength + 2) for n in shape]).astype(np.float32)
    noise = depth_up(coarse, shape[1], shape[0]).astype(np.float64) - 2.0
    return noise / np.abs(noise).mean()


class Guess:
    """How long a run and its judging will take: by its work, corrected by how long the ones before it took."""

    def __init__(self, case: BenchmarkCase, device, repeats: int):
        self.cost = probe(case.target, case.contexts, case.initial, preset("balanced"), device,
                          photo=photo_seconds((case.target,), device))
        self.repeats, self.factor = max(1, repeats), 1.3

    def seconds(self, setting: Setting, case: BenchmarkCase) -> float:
        return self.factor * self._seconds(setting, case)

    def _seconds(self, setting, case) -> float:
        total = 0.0
        for stage in setting.stages:
            size = 1 + 2 * round(stage.splatting.radius)
            factor = size**2 / 9 * (4.0 if stage.splatting.blend == "alpha" else 1.0)
            factor *= 0.7 if stage.loss.grey else 1.0
            total += factor * self.cost.seconds(stage, case.pixels, len(case.contexts))
        judging = 1e-6 * case.pixels * (1 + len(case.held_out))
        return total * self.repeats * (1 + 2 * setting.agree) + judging + 0.5

    def learn(self, setting: Setting, case: BenchmarkCase, seconds: float) -> None:
        self.factor = 0.8 * self.factor + 0.2 * min(10.0, max(0.1, seconds / self._seconds(setting, case)))
