"""What a scene needs, view by view, before anything is refined, and what each effect costs on this device."""

import time
from dataclasses import dataclass
from functools import cache

import numpy as np

from pagas_cl.app.tradeoffs.costs import full_steps
from pagas_cl.config import Config
from pagas_cl.config.presets import preset
from pagas_cl.method.cameras.effect import FEWEST, MOST, camera_seconds, decide_cameras
from pagas_cl.method.effects.decide import EFFECTS, Decision, decide, decide_consistency
from pagas_cl.method.effects.measure import Measurements, measure
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.splat.level import Schedule
from pagas_cl.method.splat.view import full_level
from pagas_cl.method.view.coarse_to_fine import resolve_pyramid
from pagas_cl.progress import Progress, Reporter, progress_of, reported, stage
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.scene.inputs import checked_depth, depth_array, depth_maps, requested_views

_ROUNDS = 3      # timed after one that compiles; the best counts
_STEPS = 5       # of each round, at full size


@dataclass(frozen=True)
class EffectCost:
    """Seconds of all steps of one view with the effect and without it, and the bytes that it takes on the device."""

    on: float
    off: float
    device_bytes: int


@dataclass(frozen=True)
class ViewAnalysis:
    """One view: its context views, the decisions, and what they rest on. `reason`: why there are none."""

    view: str
    contexts: tuple[str, ...]
    decisions: tuple[Decision, ...]
    measured: Measurements | None
    reason: str = ""


@dataclass(frozen=True)
class Analysis:
    """`views`: one entry each; `costs`: by effect, measured on `timed`; `device`: what they were measured on."""

    views: tuple[ViewAnalysis, ...]
    costs: dict[str, EffectCost]
    timed: str
    device: str
    consistency: Decision | None = None
    cameras: Decision | None = None
    pyramid: Decision | None = None

    def as_dict(self) -> dict:
        views = [{"view": view.view, "contexts": list(view.contexts), "reason": view.reason,
                  "measured": view.measured.figures if view.measured else {},
                  "effects": [decision.as_dict() for decision in view.decisions]}
                 for view in self.views]
        costs = {name: {"seconds_on": cost.on, "seconds_off": cost.off, "device_bytes": cost.device_bytes}
                 for name, cost in self.costs.items()}
        return {"device": self.device, "timed": self.timed, "costs": costs,
                **{name: getattr(self, name) and getattr(self, name).as_dict()
                   for name in ("consistency", "cameras", "pyramid")}, "views": views}


def analyze(views, depths, *, names=None, config: Config | None = None, device=None, costs: bool = True,
            progress: Reporter = None) -> Analysis:
    """Measure what each view needs; nothing is refined. Parameters as in refine_views, "balanced" by default.

    `costs`: whether to time some steps with each effect on and off, on the first view that has context views.
    """
    config, device = config or preset("balanced"), open_device(device)
    depths = depth_maps(views, depths)
    requested, photos = requested_views(views, depths, names), PhotoStore(device)
    shown = progress_of(progress)
    _, config, pyramid = resolve_pyramid(views, depths, requested, config, lambda: photos, shown)
    chooser = PartnerChooser([view.camera for view in views], depths, config.context)
    found, timed, measured_costs = [], "", {}
    for index in reported(shown, "analyze", requested):
        target, partners = views[index], chooser.choose(index)
        if not partners.contexts:
            found.append(ViewAnalysis(target.name, (), (), None, partners.reason))
            continue
        contexts, depth = [views[k] for k in partners.contexts], checked_depth(depth_array(depths[index]), target)
        measured = measure(target, contexts, depth, config, device, photos)
        decisions = decide(config, measured)[1]
        found.append(ViewAnalysis(target.name, tuple(v.name for v in contexts), tuple(decisions), measured))
        if costs and not timed:
            timed, few = target.name, (index, *partners.contexts)
            measured_costs = effect_costs(target, contexts, depth, config, measured, device, photos, shown)
    with stage(shown, "compare the depth maps", 1) as comparing:
        agreement = decide_consistency([view.camera for view in views], depths, config, device)[1]
        comparing.advance(1)
    cameras = None
    if config.effects.cameras != "set" and FEWEST <= len(views) <= MOST:
        with stage(shown, "measure the cameras", 1) as measuring:
            cameras = decide_cameras(views, depths, config, device)[0]
            if cameras.on and timed:
                measured_costs["cameras"] = EffectCost(camera_seconds(
                    [views[k] for k in few], [depths[k] for k in few], config, device, len(views)), 0.0, 0)
            measuring.advance(1)
    return Analysis(tuple(found), measured_costs, timed, device.info.title, agreement, cameras, pyramid)


def effect_costs(target, contexts, depth, config: Config, measured: Measurements, device, photos,
                 progress: Progress) -> dict[str, EffectCost]:
    """Steps of one view with each effect on and off, the others as decided."""
    @cache
    def cost(resolved: Config) -> tuple[float, int]:
        seconds, device_bytes = time_step(target, contexts, depth, resolved, device, photos)
        return seconds * full_steps(resolved), device_bytes

    costs, names = {}, [name for name in EFFECTS if getattr(config.effects, name) != "set"]
    for name in reported(progress, "time the effects", names):
        on, off = (cost(decide(config.with_settings(**{f"effects__{name}": choice}), measured)[0])
                   for choice in ("on", "off"))
        costs[name] = EffectCost(on[0], off[0], on[1] - off[1])
    return costs


def time_step(target, contexts, depth: np.ndarray, config: Config, device, photos=None) -> tuple[float, int]:
    """Seconds of a step at full size, the best mean of some rounds, and bytes of the level on the device, photos not
    counted; parameters as in refine_levels, every effect decided."""
    # a level has room for the losses of as many steps as it is made for
    config = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(_STEPS,))
    level = full_level(target, contexts, depth, config, device, photos)
    without_fits = Schedule.of(config, _STEPS).last_phase_only        # fits are a few of all steps, not of these
    best = np.inf
    for _ in range(1 + _ROUNDS):
        device.queue.finish()
        start = time.perf_counter()
        level.run(_STEPS, schedule=without_fits)
        device.queue.finish()
        best = min(best, time.perf_counter() - start)
    needed = sum(buffer.size for buffer in level.buffers.held())
    level.release()
    return best / _STEPS, needed
