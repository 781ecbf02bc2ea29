"""What a refinement will cost on this device: a model with three numbers, measured by short runs.

One view takes

    photos photo + pixels ((1 + contexts) setup + sum over levels of scale^2 steps step)

seconds: work is linear in pixels and in steps; `photos` is how many are read per view, 1 where many views share theirs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pagas_cl.config import Config, Context
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError
from pagas_cl.method.cameras.effect import camera_seconds
from pagas_cl.method.effects.decide import agreement_rounds, between_rounds, decide, resolve_effects
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels
from pagas_cl.method.view.coarse_to_fine import pyramid_at, resolve_pyramid, sizes_of
from pagas_cl.progress import NONE
from pagas_cl.scene.choice import MOST_HELD_OUT, ContextChooser, shared_out
from pagas_cl.scene.inputs import depth_array, requested_views
from pagas_cl.scene.sampling import sample_depth

_AROUND = 6               # neighbours of a view, to measure what refining cameras takes
_REPEATS = 3
_SHORT, _MOST = 8, 4000   # steps of the short run, enough that colours are fitted as often; and most of the long one
RUNS = 2 * (2 + 2 * _REPEATS)      # that two kinds of settings are probed by, if the first long one is long enough
_RATE = 1e-5              # of the runs that are timed: depths stay, for Gaussians that are torn apart take longer
_PHOTOS = 4               # that are read to know how long one takes: they differ
_LEAST = 0.25             # seconds that the long run must take longer than the short one


@dataclass(frozen=True)
class Cost:
    """Seconds: `photo` to read and upload one, `setup` per pixel of each view, `step` per pixel and step."""

    photo: float
    setup: float
    step: float

    def seconds(self, config: Config, pixels: float, contexts: int, photos: float = 1.0) -> float:
        """Expected time of a view of `pixels` with `contexts` context views; an early stop may shorten it."""
        setup = (1 + min(contexts, config.context.number)) * self.setup
        return photos * self.photo + pixels * (setup + full_steps(config) * self.step)


def full_steps(config: Config) -> float:
    """Steps of `config`, one of a level counted by its share of the full size."""
    return sum(scale**2 * number for scale, number in zip(config.pyramid.scales, config.pyramid.steps))


def views_of_step(config: Config, contexts: int) -> int:
    """Context views of a step, where there are `contexts` to choose from."""
    contexts = min(contexts, config.context.number)
    return min(config.solver.views_per_step or contexts, contexts)


def view_steps(config: Config, contexts: int) -> float:
    """The steps times their context views."""
    return full_steps(config) * views_of_step(config, contexts)


def preset_ladder() -> list[tuple[str, Config]]:
    """Settings along the measured front, cheapest first: about half the error each time or two, until "balanced"."""
    def shorter(name, *steps_and_rates):
        return [(f"{name}, {n} steps", preset(name).with_settings(pyramid__steps=(n,), solver__rate=rate))
                for n, rate in steps_and_rates]

    return [*shorter("fast", (6, 0.2), (12, 0.18)), ("fast", preset("fast")),
            *shorter("balanced", (35, 0.08), (50, 0.07), (75, 0.06), (100, 0.045)),
            ("balanced", preset("balanced")), ("accurate", preset("accurate"))]


def probe(given: ViewInput, config: Config, ran=lambda: None) -> Cost:
    """Measure the cost of `config`'s kind of settings on one view by short runs, calling ran() after each."""
    given = replace(given, contexts=given.contexts[:config.context.number])

    def timed(steps: int) -> float:
        start = time.perf_counter()
        with resolve_effects(given, config) as (own, _, _, used):
            short = own.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,), solver__patience=0,
                                      solver__rate=_RATE)
            refine_levels(used, short)
        took = time.perf_counter() - start
        ran()
        return took

    timed(_SHORT)  # compiles and uploads
    setup, step = setup_and_step(timed)
    views, pixels = (given.target, *given.contexts), given.depth.size
    return Cost(_photo_seconds(views, given.device), setup / pixels / len(views), step / pixels)


def setup_and_step(timed) -> tuple[float, float]:
    """Seconds before the first step, and of each, from `timed(steps)`, the least of some: other work only adds."""
    def least(steps: int) -> float:
        return min(timed(steps) for _ in range(_REPEATS))

    short, steps = least(_SHORT), 3 * _SHORT
    while timed(steps) - short < _LEAST and 2 * steps <= _MOST:
        steps *= 2
    step = max(least(steps) - short, 1e-9) / (steps - _SHORT)
    return max(short - _SHORT * step, 0.0), step


def _photo_seconds(views, device) -> float:
    """Seconds to read and upload one photo: the mean over the first few of `views`, the least of some times each."""
    def once(view):
        start = time.perf_counter()
        PhotoStore(device).photo(view)
        device.queue.finish()
        return time.perf_counter() - start

    return float(np.mean([min(once(view) for _ in range(_REPEATS)) for view in views[:_PHOTOS]]))


class Costs:
    """Expected times of any settings for the views of a scene (as refine_views has them), each kind probed once."""

    def __init__(self, views, depths, device, names=None, ran=lambda: None):
        samples = [None if depth is None else sample_depth(depth_array(depth)) for depth in depths]
        requested = [k for k in requested_views(views, depths, names)
                     if samples[k] is not None and len(samples[k].rows)]
        if not requested:
            raise InputError("no view to be refined has a depth map with a valid pixel: nothing to time")
        self.device, self._ran = device, ran
        self._views, self._depths, self._requested = views, depths, requested
        self._known = {}
        self.pixels = [views[k].camera.width * views[k].camera.height for k in requested]
        most = max(config.context.number for _, config in preset_ladder()) + MOST_HELD_OUT
        chooser = ContextChooser([view.camera for view in views], samples, Context(number=most))
        by_size = [requested[k] for k in np.argsort(self.pixels, kind="stable")]
        middle = len(by_size) // 2
        near = ((k, chooser.choose(k).indices) for k in by_size[middle:] + by_size[:middle])
        self._probed, self._around = next(((k, around) for k, around in near if around), (None, ()))
        if self._probed is None:
            raise InputError("no view has a usable context view: nothing would be refined")

    def seconds(self, config: Config) -> float:
        """Expected mean time per view with the effects that the probed view needs, the smaller sizes that come first,
        all rounds of agreement that may be, and its share of refining cameras where these are off."""
        views, number = self._views, len(self.pixels)
        contexts, held_out = shared_out([views[k] for k in self._around], config.context.number)
        given = ViewInput(views[self._probed], contexts, depth_array(self._depths[self._probed]), self.device,
                          PhotoStore(self.device), held_out)
        kind = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(1,), solver__rate=1.0,
                                    solver__final_rate=1.0, solver__patience=0)
        cost = self._once(kind, lambda: probe(given, kind, self._ran))
        measured = None
        if config.effects.measured:
            measured = self._once("effects", lambda: measure(given, config))
        seconds = len(views) * self._once(("cameras", config.effects.cameras), lambda: self._camera_seconds(config))
        start = self._once(("pyramid", config.effects.pyramid), lambda: resolve_pyramid(
            views, self._depths, self._requested, config, lambda: PhotoStore(self.device), NONE)[2])
        sizes = sizes_of(views, self._requested, config) if start is not None and start.on else ()
        photos = min(len(views), number + config.context.number + MOST_HELD_OUT) / number      # read once each
        times = max(agreement_rounds(config, number) - 1, 0)
        for scale in (*sizes, 1.0):
            own = replace(config, pyramid=pyramid_at(scale, config.pyramid))
            resolved, few = decide(own, measured)[0], between_rounds(own)
            runs = [(1, resolved), *([(times, replace(resolved, pyramid=few.pyramid))] if few else ())]
            seconds += sum(many * cost.seconds(settings, scale**2 * pixels, len(contexts), photos)
                           for many, settings in runs for pixels in self.pixels)
        return seconds / number

    def _once(self, key, found: Callable[[], Any]) -> Any:
        """found(), the first time for each `key`: what it depends on of the settings."""
        if key not in self._known:
            self._known[key] = found()
        return self._known[key]

    def _camera_seconds(self, config: Config) -> float:
        """Of each view, by a few neighbours."""
        few = (self._probed, *self._around[:_AROUND])
        depths = [None if self._depths[k] is None else depth_array(self._depths[k]) for k in few]
        return camera_seconds([self._views[k] for k in few], depths, config, self.device, len(self._views))

    def choose(self, seconds: float, change=lambda config: config) -> tuple[str, Config, float]:
        """The last of `preset_ladder`, through `change(config)`, that takes at most `seconds` a view; and its time."""
        found = None
        for name, config in preset_ladder():
            config = change(config)
            expected = self.seconds(config)
            if expected > seconds:
                break
            found = name, config, expected
        if found is None:
            raise InputError(f"a view takes at least {expected:.3g} s on {self.device.info.title} with the cheapest "
                             f"settings, {seconds:.3g} s were allowed; give more time or refine smaller photos")
        return found
