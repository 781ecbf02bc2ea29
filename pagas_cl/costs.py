"""What a refinement will cost on this device: a model with four numbers, measured by a short probe.

One view takes  photo + pixels (1 + contexts) setup + sum over levels of scale^2 pixels (steps per_step + view-steps
per_view_step)  seconds: work is linear in pixels, in steps and in the context views of a step.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Config, preset
from pagas_cl.errors import InputError

log = logging.getLogger("pagas_cl")

_SHORT, _MOST = 1, 4000   # steps of the short run, and most of the long one
_LEAST = 0.25             # seconds that the long run must take longer than the short one


@dataclass(frozen=True)
class Cost:
    """Seconds: `photo` to read and upload one photo, `setup` per pixel of the target and each context view,
    `per_step` per pixel and step, `per_view_step` per pixel, step and context view of that step."""

    photo: float
    setup: float
    per_step: float
    per_view_step: float

    def seconds(self, config: Config, pixels: float, contexts: int) -> float:
        """Expected time of a view of `pixels` with `contexts` context views; an early stop may shorten it."""
        contexts = min(contexts, config.context.number)
        each = min(config.solver.views_per_step or contexts, contexts)
        work = sum(scale**2 * steps for scale, steps in zip(config.pyramid.scales, config.pyramid.steps))
        return self.photo + pixels * ((1 + contexts) * self.setup + work * (self.per_step + each * self.per_view_step))


@dataclass(frozen=True)
class Choice:
    """Settings that fit a time. `seconds`: expected mean per view, refining alone; `views`: how many."""

    name: str
    config: Config
    seconds: float
    views: int


def rungs() -> list[tuple[str, Config]]:
    """Settings along the measured front of error against time, cheapest first: about half as much error every time or
    two, until the knee at "balanced"."""
    fast, balanced, accurate = (preset(name) for name in ("fast", "balanced", "accurate"))
    quick = [(f"fast, {n} steps", fast.with_settings(pyramid__steps=(n,), solver__rate=rate))
             for n, rate in ((10, 0.1), (20, 0.1))]
    middle = [(f"balanced, {n} steps", balanced.with_settings(pyramid__steps=(n,), solver__rate=0.06 if n < 75 else 0.04))
              for n in (50, 75, 100)]
    return [*quick, ("fast", fast), *middle, ("balanced", balanced),
            ("balanced, 300 steps", balanced.with_settings(pyramid__steps=(300,))), ("accurate", accurate)]


def probe(target, contexts, depth, config: Config, device, *, witness=None) -> Cost:
    """Measure the cost of `config`'s kind of settings on one view: some short runs, a second or two on a GPU.

    Parameters
    ----------
    target : View
    contexts : list of View
    depth : ndarray of shape (H, W)
        Initial depth of the target.
    witness : View, optional
        As in refine_depth.
    """
    from pagas_cl.refine import settle
    from pagas_cl.splat import PhotoStore, refine_levels

    photos, depth = PhotoStore(device), np.asarray(depth, np.float64)
    contexts = contexts[:config.context.number]

    def measure(steps: int, each: int) -> float:
        start = time.perf_counter()
        settled, _, exposure = settle(target, contexts, depth, config, device, photos)
        short = settled.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,), solver__patience=0,
                                      solver__views_per_step=each)
        refine_levels(target, contexts, depth, short, device, photos, witness=witness, exposure=exposure)
        return time.perf_counter() - start

    for each in (1, min(3, len(contexts))):
        measure(_SHORT, each)  # compiles and uploads
    return _solve(measure, len(contexts), target.camera.width * target.camera.height, _photo_seconds(target, device))


def _solve(measure, contexts: int, pixels: int, photo: float) -> Cost:
    """The Cost from `measure(steps, views a step)`, the smaller of two times each."""
    def least(steps, each):
        return min(measure(steps, each), measure(steps, each))

    short, long, steps = least(_SHORT, 1), 0.0, 8
    while steps <= _MOST:
        long = least(steps, 1)
        if long - short >= _LEAST:
            break
        steps *= 3
    else:
        steps //= 3
    one = max(long - short, 1e-9) / (steps - _SHORT)        # seconds of a step with one view
    each = min(3, contexts)
    more = (least(steps, each) - long) / (steps * (each - 1)) if each > 1 else one
    view = min(max(more, 0.0), one)                         # a view costs something, and so does the step itself
    setup = max(short - _SHORT * one, 0.0)
    return Cost(photo, setup / pixels / (1 + contexts), (one - view) / pixels, view / pixels)


def _photo_seconds(view, device) -> float:
    from pagas_cl.splat import PhotoStore

    start = time.perf_counter()
    PhotoStore(device).photo(view)
    device.queue.finish()
    return time.perf_counter() - start


class Costs:
    """Expected times of any settings for the views of a scene, each kind of settings probed once.

    Parameters
    ----------
    views : list of View
    depths : list of (ndarray of shape (H, W) or None)
    device : Device
    names : list of str, optional
        Views to be refined; by default all with a depth.
    """

    def __init__(self, views, depths, device, names=None):
        from pagas_cl.scene.choice import ContextChooser

        asked = [k for k, depth in enumerate(depths) if depth is not None and np.any(np.asarray(depth) > 0)
                 and (names is None or views[k].name in names or views[k].stem in names)]
        if not asked:
            raise InputError("no view to be refined has a depth map with a valid pixel: nothing to estimate the time of")
        self.views, self.depths, self.device = views, depths, device
        self._known, self._measured = {}, None
        self.pixels = [views[k].camera.width * views[k].camera.height for k in asked]
        settings = replace(preset("balanced").context, number=preset("accurate").context.number + 1)
        chooser = ContextChooser([view.camera for view in views], depths, settings)
        by_size = [asked[k] for k in np.argsort(self.pixels, kind="stable")]
        middle = len(by_size) // 2
        for k in by_size[middle:] + by_size[:middle]:
            self.target, self.chosen = k, chooser.choose(k).indices
            if self.chosen:
                return
        raise InputError("no view has a usable context view: nothing would be refined")

    def seconds(self, config: Config) -> float:
        """Expected mean time per view, with the effects that the probed view calls for."""
        contexts = [self.views[k] for k in self.chosen[:config.context.number]]
        settled = self._settled(config, contexts)
        kind = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(1,), solver__views_per_step=1,
                                    solver__rate=1.0, solver__final_rate=1.0, solver__patience=0)
        if kind not in self._known:
            spare = self.chosen[config.context.number:]
            self._known[kind] = probe(self.views[self.target], contexts, self.depths[self.target], kind, self.device,
                                      witness=self.views[spare[0]] if spare else None)
        cost = self._known[kind]
        return float(np.mean([cost.seconds(settled, pixels, len(contexts)) for pixels in self.pixels]))

    def _settled(self, config: Config, contexts) -> Config:
        from pagas_cl.effects import decide, measure

        if set(vars(config.effects).values()) <= {"set", "off"} and not config.loss.exposure:
            return decide(config, None)[0]
        if self._measured is None:
            self._measured = measure(self.views[self.target], contexts, np.asarray(self.depths[self.target], np.float64),
                                     config, self.device)
        return decide(config, self._measured)[0]

    def choose(self, seconds: float, change=None) -> Choice:
        """The last of `rungs` whose expected time per view is at most `seconds`.

        `change(config)` is applied to every rung first (settings that the caller insists on).
        """
        if not seconds > 0:
            raise InputError(f"the time per view is {seconds!r}, expected seconds above 0")
        found, cheapest = None, None
        for name, config in rungs():
            config = change(config) if change else config
            expected = self.seconds(config)
            cheapest = cheapest or expected
            if expected > seconds:
                break
            found = Choice(name, config, expected, len(self.pixels))
        if found is None:
            raise InputError(f"a view takes at least {cheapest:.3g} s on {self.device.info.title} with the cheapest "
                             f"settings, {seconds:.3g} s were allowed; give more time or refine smaller photos")
        return found
