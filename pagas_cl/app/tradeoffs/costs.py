"""What a refinement will cost on this device: a model with four numbers, measured by a short probe.

One view takes

    photos photo + pixels (1 + contexts) setup + sum over levels of scale^2 pixels
    (steps per_step + view-steps per_view_step)

seconds: work is linear in pixels, in steps and in the context views of a step; `photos` is how many are read per view,
1 where many views share theirs.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pagas_cl.config import Config, Context
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError
from pagas_cl.method.cameras.effect import camera_seconds
from pagas_cl.method.effects.decide import agreement_rounds, between_rounds, decide, resolve_effects
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore, refine_levels
from pagas_cl.method.view.coarse_to_fine import pyramid_at, resolve_pyramid, sizes_of
from pagas_cl.progress import NONE, Stage
from pagas_cl.scene.choice import MOST_HELD_OUT, ContextChooser, shared_out
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.names import place_of
from pagas_cl.scene.sampling import sample_depth

_AROUND = 6               # neighbours of a view, to measure what refining cameras takes
_REPEATS = 3
_SHORT, _MOST = 8, 4000   # steps of the short run, enough that colours are fitted as often; and most of the long one
RUNS = 2 * (3 + 3 * _REPEATS)      # that two kinds of settings are probed by, if the first long one is long enough
_FEW = 64                 # views that are looked at one by one
_RATE = 1e-5              # of the runs that are timed: depths stay, for Gaussians that are torn apart take longer
_PHOTOS = 4               # that are read to know how long one takes: they differ
_LEAST = 0.25             # seconds that the long run must take longer than the short one


@dataclass(frozen=True)
class Cost:
    """Seconds: `photo` to read and upload one photo, `setup` per pixel of the target and each context view,
    `per_step` per pixel and step, `per_view_step` per pixel, step and context view of that step."""

    photo: float
    setup: float
    per_step: float
    per_view_step: float

    def seconds(self, config: Config, pixels: float, contexts: int, photos: float = 1.0) -> float:
        """Expected time of a view of `pixels` with `contexts` context views; an early stop may shorten it."""
        setup = (1 + min(contexts, config.context.number)) * self.setup
        steps = self.per_step * full_steps(config) + self.per_view_step * view_steps(config, contexts)
        return photos * self.photo + pixels * (setup + steps)


def full_steps(config: Config) -> float:
    """Steps of `config`, one of a level counted by its share of the full size."""
    return sum(scale**2 * number for scale, number in zip(config.pyramid.scales, config.pyramid.steps))


def view_steps(config: Config, contexts: int) -> float:
    """The same times the context views of a step, where there are `contexts` to choose from."""
    contexts = min(contexts, config.context.number)
    return full_steps(config) * min(config.solver.views_per_step or contexts, contexts)


@dataclass(frozen=True)
class Choice:
    """Settings that fit a time. `seconds`: expected mean per view, refining alone; `views`: how many."""

    name: str
    config: Config
    seconds: float
    views: int


def preset_ladder() -> list[tuple[str, Config]]:
    """Settings along the measured front of error against time, cheapest first: about half as much error every time or
    two, until the knee at "balanced"."""
    def shorter(name, *steps_and_rates):
        return [(f"{name}, {n} steps", preset(name).with_settings(pyramid__steps=(n,), solver__rate=rate))
                for n, rate in steps_and_rates]

    return [*shorter("fast", (6, 0.2), (12, 0.18)), ("fast", preset("fast")),
            *shorter("balanced", (35, 0.08), (50, 0.07), (75, 0.06), (100, 0.045)),
            ("balanced", preset("balanced")), ("accurate", preset("accurate"))]


def probe(target, contexts, depth, config: Config, device, *, photo: float, held_out=(), ran=lambda: None) -> Cost:
    """Measure the cost of `config`'s kind of settings on one view by short runs, calling ran() after each; `photo` as
    `photo_seconds` found."""
    photos = PhotoStore(device)
    contexts = contexts[:config.context.number]

    def timed(steps: int, each: int) -> float:
        start = time.perf_counter()
        with resolve_effects(target, contexts, depth, config, device, photos) as (own, _, _, used):
            short = own.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,), solver__patience=0,
                                      solver__views_per_step=each, solver__rate=_RATE)
            refine_levels(target, used, depth, short, device, photos, held_out=held_out)
        took = time.perf_counter() - start
        ran()
        return took

    for each in (1, min(3, len(contexts))):
        timed(_SHORT, each)  # compiles and uploads
    return _solve(timed, len(contexts), target.camera.width * target.camera.height, photo)


def _solve(measure, contexts: int, pixels: int, photo: float) -> Cost:
    """The Cost from `measure(steps, views a step)`, the least of some times each: other work only adds to a time."""
    def least(steps, each):
        return min(measure(steps, each) for _ in range(_REPEATS))

    steps = 3 * _SHORT
    short = least(_SHORT, 1)
    while measure(steps, 1) - short < _LEAST and 2 * steps <= _MOST:
        steps *= 2
    long = least(steps, 1)
    one = max(long - short, 1e-9) / (steps - _SHORT)        # seconds of a step with one view
    each = min(3, contexts)
    fewer = max(steps // each, _SHORT + 1)                  # as much work with several views a step
    several = (least(fewer, each) - short + _SHORT * one) / fewer
    more = (several - one) / (each - 1) if each > 1 else one
    view = min(max(more, 0.0), one)                         # a view costs something, and so does the step itself
    setup = max(short - _SHORT * one, 0.0)
    return Cost(photo, setup / pixels / (1 + contexts), (one - view) / pixels, view / pixels)


def photo_seconds(views, device) -> float:
    """Seconds to read and upload one photo: the mean over the first few of `views`, the least of some times each."""
    def once(view):
        start = time.perf_counter()
        PhotoStore(device).photo(view)
        device.queue.finish()
        return time.perf_counter() - start

    return float(np.mean([min(once(view) for _ in range(_REPEATS)) for view in views[:_PHOTOS]]))


class Costs:
    """Expected times of any settings for the views of a scene (as refine_views has them), each kind probed once."""

    def __init__(self, views, depths, device, names=None, timing: Stage | None = None):
        self._timing, self._ran = timing, 0
        samples = [None if depth is None else sample_depth(depth_array(depth)) for depth in depths]
        wanted = {place_of(name, [view.name for view in views]) for name in names or ()}
        requested = [k for k, sample in enumerate(samples) if sample is not None and len(sample.rows)
                 and (names is None or k in wanted)]
        if not requested:
            raise InputError("no view to be refined has a depth map with a valid pixel: nothing to time")
        self.device, self._scene, self._known, self._cameras, self._measured = device, len(views), {}, {}, None
        self._given, self._far_off = (views, depths, requested), {}
        self.pixels = [views[k].camera.width * views[k].camera.height for k in requested]
        most = max(config.context.number for _, config in preset_ladder()) + MOST_HELD_OUT
        chooser = ContextChooser([view.camera for view in views], samples, Context(number=most))
        self._read = [(k, *chooser.choose(k).indices) for k in requested] if len(requested) <= _FEW else []
        by_size = [requested[k] for k in np.argsort(self.pixels, kind="stable")]
        middle = len(by_size) // 2
        for k in by_size[middle:] + by_size[:middle]:
            around = chooser.choose(k).indices
            self.target, self.chosen = views[k], [views[j] for j in around]
            if self.chosen:
                self.depth = depth_array(depths[k])
                self._few = [(views[j], None if depths[j] is None else depth_array(depths[j]))
                             for j in (k, *around[:_AROUND])]
                return
        raise InputError("no view has a usable context view: nothing would be refined")

    def seconds(self, config: Config) -> float:
        """Expected mean time per view, with the effects that the probed view needs, with the smaller sizes that come
        first, with all rounds of agreement that views may have, and with each one's share of refining the scene's
        cameras where these are off."""
        contexts, held_out = shared_out(self.chosen, config.context.number)
        kind = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(1,), solver__views_per_step=1,
                                    solver__rate=1.0, solver__final_rate=1.0, solver__patience=0)
        if kind not in self._known:
            self._known[kind] = probe(self.target, contexts, self.depth, kind, self.device, photo=self._photo,
                                      held_out=held_out, ran=self._report_run)
        cost = self._known[kind]
        photos = self._photos(config.context.number)
        times = max(agreement_rounds(config, len(self.pixels)) - 1, 0)
        choice = config.effects.cameras
        if choice not in self._cameras:
            self._cameras[choice] = camera_seconds(*zip(*self._few), config, self.device, self._scene)
        start = config.effects.pyramid
        if start not in self._far_off:
            found = resolve_pyramid(*self._given, config, lambda: PhotoStore(self.device), NONE)[2]
            self._far_off[start] = found is not None and found.on
        views, _, requested = self._given
        seconds = self._cameras[choice] * self._scene
        for scale in (*sizes_of(views, requested, config), 1.0) if self._far_off[start] else (1.0,):
            own = replace(config, pyramid=pyramid_at(scale, config.pyramid))
            resolved, few = self._resolved(own, contexts), between_rounds(own)
            runs = [(1, resolved), *([(times, replace(resolved, pyramid=few.pyramid))] if few else ())]
            seconds += sum(number * cost.seconds(settings, scale**2 * pixels, len(contexts), photos)
                           for number, settings in runs for pixels in self.pixels)
        return seconds / len(self.pixels)

    def _report_run(self) -> None:
        self._ran += 1
        if self._timing:
            self._timing.advance(min(self._ran, RUNS - 1))

    @cached_property
    def _photo(self) -> float:
        return photo_seconds((self.target, *self.chosen), self.device)

    def _photos(self, contexts: int) -> float:
        """Photos read per view: of the view, its context views and its held-out views, each read once."""
        read = {k for group in self._read for k in group[:1 + contexts + MOST_HELD_OUT]}
        return len(read) / len(self._read) if read else 1.0

    def _resolved(self, config: Config, contexts) -> Config:
        if not config.effects.measured:
            return decide(config, None)[0]
        if self._measured is None:
            self._measured = measure(self.target, contexts, self.depth, config, self.device)
        return decide(config, self._measured)[0]

    def choose(self, seconds: float, change=None) -> Choice:
        """The last of `preset_ladder`, each through `change(config)`, whose expected time per view is at most
        `seconds`."""
        if not seconds > 0:
            raise InputError(f"the time per view is {seconds!r}, expected seconds above 0")
        found = None
        for name, config in preset_ladder():
            config = change(config) if change else config
            expected = self.seconds(config)
            if expected <= seconds:
                found = Choice(name, config, expected, len(self.pixels))
            elif found:
                break
            else:
                raise InputError(f"a view takes at least {expected:.3g} s on {self.device.info.title} with the "
                                 f"cheapest settings, {seconds:.3g} s were allowed; give more time or refine smaller "
                                 "photos")
        return found
