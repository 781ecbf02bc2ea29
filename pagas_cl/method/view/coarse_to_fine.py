"""The effect `pyramid` (method section 8.3): where a start is far off, all views are refined at smaller sizes first."""

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config, Pyramid
from pagas_cl.errors import DeviceError, DeviceMemoryError, InputError, log, short
from pagas_cl.method.effects.decide import Decision, add_decision
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore, ViewInput, better_start, reading_ahead
from pagas_cl.method.splat.carry_over import follow
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.host import side_by_side
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.scene.camera import Size
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import stretched_depth
from pagas_cl.scene.inputs import Depth, depth_array
from pagas_cl.scene.sampling import sample_depth
from pagas_cl.scene.view import View, joined, smaller

FAR_OFF = 0.05           # share of samples, see far_off, above which smaller sizes come first: near starts have up to
                         # 0.03 on made scenes, where photos are noisy, those a pixel or more off 0.1 and more
_LOOKED_AT, _AT = 4, 0.5     # views that are measured to know whether the start is far off, and the size they have
_EARLY = 0.33            # smoothness.early at these sizes: how far steps reach, smoothness decides
_SMALL = 0.25            # sizes below this one say too little where photos have fewer pixels than pyramid.least_side
_LITTLE = 0.85           # of the mismatch with photos that took no part left by the first size, median of the pairs: of
                         # the castle 0.7, of made scenes off by 1 or 2 px 0.1 to 0.2, of a HoloLens' sensor 0.95
_TWICE, _ENOUGH = 0.5, 300   # below this size steps cost little: twice as many, up to so many

Refine: TypeAlias = Callable[[list[View], list[Any], Config, int, float], list[DepthResult]]
"""Refines depth maps: views, depth maps and settings of a size; its place in the row of sizes, from 0, and the size."""


@dataclass(frozen=True, eq=False)
class Starts:
    """What full size begins with in place of the depth maps that were `given`: `depths`, settings in which
    effects.pyramid is "set", and its decision (None where it was "set"). `judged`: by view, at the first size that it
    had, what photos that took no part say of the given depths; at full size they judge those that sizes have left."""

    given: Sequence[Any]
    depths: list[Any]
    config: Config
    decision: Decision | None
    judged: dict[str, dict[str, Any]] = field(default_factory=dict)

    def noted(self, result: DepthResult) -> DepthResult:
        """A result at full size, with decision and `judged` in its report."""
        if result.name in self.judged:
            result.report["smaller_sizes"] = self.judged[result.name]
        add_decision(result.report, self.decision)
        return result

    def log_moved(self, views: Sequence[View], results: Sequence[DepthResult]) -> None:
        """Say which of the views that full size refuses do not have the depth that was given."""
        if all(one is other for one, other in zip(self.depths, self.given)):
            return
        moved = [result.name for k, result in joined(views, results)
                 if result.reason and self.depths[k] is not self.given[k]]
        if moved:
            log.warning("of the views that stay unchanged at full size %d have the depth that smaller sizes have left, "
                        "not the one that was given, which comes back with the effect pyramid off (--effect "
                        "pyramid=off): %s", len(moved), ", ".join(map(short, moved[:5])))


@dataclass(frozen=True, eq=False)
class Movement:
    """What a smaller size, `scale` of the full one, has found: `result`, and the depth map `given` there at first."""

    given: Depth
    result: DepthResult
    scale: float


def moved_along(depth: np.ndarray, movement: Movement, device: Device) -> np.ndarray:
    """A depth map as it was given, of any size (H, W), moved along with what a smaller size has found: each depth by
    the share by which those around it moved that were of the same surface, within a pixel of parallax there."""
    with translate_cl_errors(device, "carrying depths over"):
        moved = upload(device, depth.astype(np.float32, copy=False))
        move_along(depth.shape, movement, device, moved)
        out = download(device, moved, depth.shape)
        release(moved)
    return out


def move_along(shape: tuple[int, int], movement: Movement, device: Device, depth: cl.Buffer) -> None:
    """The same of a depth map of this `shape` on the device, where it is."""
    result, (height, width) = movement.result, shape
    found = [upload(device, np.asarray(values, np.float32)) for values in (
        depth_array(movement.given), result.depth, result.parallax, result.deviation)]
    small = Size(*result.depth.shape[::-1])
    follow(device, small, movement.scale, *found).carry_over(device, depth, Size(width, height))
    release(*found)


def resolve_pyramid(views: Sequence[View], depths: Sequence[Depth | None], requested: Collection[int], config: Config,
                    photos: Callable[[], PhotoStore], progress: Progress) -> tuple[tuple[float, ...], Config,
                                                                              Decision | None]:
    """Decide effects.pyramid for the views `requested`: the smaller sizes that come first, settings in which it is
    "set", and the decision (None where it was "set": no size comes first)."""
    choice, evidence = config.effects.pyramid, float("nan")
    if choice == "set":
        return (), config, None
    if choice == "auto":
        with stage(progress, "measure the start", 1) as measuring:
            with suppress(DeviceError):     # no device here, or too small a one: who refines has another, or says so
                evidence = far_off(views, depths, requested, config, photos())
            measuring.advance(1)
    decision = Decision.of("pyramid", config, evidence, FAR_OFF, evidence > FAR_OFF,
                           "share of samples that match two or more pixels away at half size")
    sizes = sizes_of(views, requested, config) if decision.on else ()
    if decision.on and not sizes:
        decision = replace(decision, on=False, reason=f"{decision.reason}; photos are too small for pyramid.far_off")
    log.debug("%s", decision)
    return sizes, replace(config, effects=replace(config.effects, pyramid="set")), decision


def sizes_of(views: Sequence[View], requested: Collection[int], config: Config) -> tuple[float, ...]:
    """Those of pyramid.far_off at which the photos of all views `requested` say enough."""
    side = min((max(views[k].camera.width, views[k].camera.height) for k in requested), default=0)
    least = config.pyramid.least_side
    return tuple(scale for scale in config.pyramid.far_off if scale >= _SMALL or scale * side >= least)


def pyramid_at(scale: float, pyramid: Pyramid) -> Pyramid:
    """Levels of the size `scale`, where full size has those of `pyramid`: the last one alone."""
    if scale == 1:
        return pyramid
    steps = pyramid.steps[-1]
    longer = max(steps, min(2 * steps, _ENOUGH)) if scale < _TWICE else steps
    return replace(pyramid, scales=(1.0,), steps=(longer,))


def far_off(views: Sequence[View], depths: Sequence[Depth | None], requested: Collection[int], config: Config,
            photos: PhotoStore) -> float:
    """Share of samples that match clearly better two or more pixels away, at half size: mean of a few of the views
    `requested`, 0 without context views. A photo that cannot be read is left out: its view says so later."""
    few = list(requested)[::-(-len(requested) // _LOOKED_AT)]
    found: list[float] = []
    for given in _inputs(views, depths, few, config, photos):
        with suppress(InputError):
            found.append(measure(given, config, _AT).depth_far_off if given.contexts else 0.0)
    return float(np.mean(found)) if found else 0.0


def _inputs(views: Sequence[View], depths: Sequence[Depth | None], few: Sequence[int], config: Config,
            photos: PhotoStore) -> Iterator[ViewInput]:
    """Those of the views `few`, with the context views chosen for them."""
    wanted = set(few)
    samples = side_by_side(lambda k: sample_depth(depth_array(depths[k])) if k in wanted else None, range(len(views)))
    chooser = ContextChooser([view.camera for view in views], samples, config.context)
    for k in few:
        contexts = [views[j] for j in chooser.choose(k).indices]
        yield ViewInput(views[k], contexts, depth_array(depths[k]), photos.device, photos)


def through_sizes(refine: Refine, views: Sequence[View], depths: Sequence[Depth | None], requested: Collection[int],
                  config: Config, here: Callable[[], PhotoStore], keep: Callable[[np.ndarray], Any] | None = None,
                  photos: PhotoStore | None = None, progress: Progress = NONE) -> Starts:
    """Resolve effects.pyramid; depths of the views `requested`, where it is on, moved along with what `refine` finds at
    one of the smaller sizes after the other, but for where photos, of `here()`, match better near the given ones. All
    sizes are given up where the first one gains little. `keep` replaces a depth map by what stands for it. `photos`,
    where `refine` takes them from there: those of the next size are read meanwhile."""
    sizes, resolved, decision = resolve_pyramid(views, depths, requested, config, here, progress)
    config = resolved.with_settings(smoothness__early=min(config.smoothness.early, _EARLY))
    store = here() if sizes else None       # before the first size is refined: where there is none, no work is lost
    found: dict[int, Movement] = {}
    judged: dict[str, dict[str, Any]] = {}
    at_size = {scale: [smaller(view, scale) for view in views] for scale in sizes} | {1.0: views}

    def kept(depth: np.ndarray) -> Any:
        return keep(depth) if keep else depth

    def carried(k: int, source: Depth | None) -> np.ndarray:
        return moved_along(depth_array(source), found[k], store.device)

    def shrunk(scale: float) -> dict[int, Any]:
        """The depths at a size, as they were before any was refined."""
        cameras = {k: at_size[scale][k].camera for k in requested}
        depth_maps = side_by_side(lambda k: kept(stretched_depth(depth_array(depths[k]), cameras[k].width,
                                                                 cameras[k].height)), requested)
        return dict(zip(requested, depth_maps))

    with ThreadPoolExecutor(1) as ahead:        # shrinks depth maps to the next size while one is refined
        coming = {scale: ahead.submit(shrunk, scale) for scale in sizes[:1]}
        for number, (scale, following) in enumerate(pairwise([*sizes, 1.0])):
            given = coming[scale].result()
            if following not in (scale, 1.0):
                coming = {following: ahead.submit(shrunk, following)}
            small = at_size[scale]
            start = [kept(carried(k, given.get(k))) if k in found else given.get(k) for k in range(len(views))]
            if not any((depth_array(start[k]) > 0).any() for k in requested):       # too small a surface for this size
                continue
            settings = replace(config, pyramid=pyramid_at(scale, config.pyramid))
            with reading_ahead(at_size[following] if following != scale else [], photos):
                results = refine([*small], start, settings, number, scale)
            for result in results:
                costs = result.report.get("held_out_costs", ())
                costs = [(before, before) for before, _ in costs] if result.reason else costs
                judged.setdefault(result.name, {"scale": scale, "held_out_costs": costs})
            if store.device.is_lost:
                store.renewed()
            if photos is not None and following != scale:
                photos.forget(small)
            if not found and decision is not None and _gains_little(results, decision):     # the first that moved any
                reason = f"{decision.reason}; given up, since photos that took no part hardly agree better at {scale:g}"
                given_up = replace(decision, on=False, reason=reason)
                log.debug("%s", given_up)
                if photos is not None and following != 1:
                    photos.forget(at_size[following])
                return Starts(depths, [*depths], resolved, given_up)
            for k, result in joined(small, results):
                if not result.reason:
                    found[k] = Movement(given[k], result, scale)
    start = [*depths]
    if not found:
        return Starts(depths, start, resolved, decision, judged)
    with stage(progress, "compare the starts", len(found)) as comparing:
        for done, (k, view) in enumerate(zip(found, _inputs(views, depths, [*found], config, store)), start=1):
            move, better = partial(move_along, view.depth.shape, found[k], store.device), None
            with (suppress(InputError, DeviceMemoryError),      # said where the view is refined, or made to fit there
                  translate_cl_errors(store.device, "comparing starts")):
                better = better_start(view, move, config)
            made = carried(k, depths[k]) if better is None else better
            if not np.array_equal(made, view.depth):
                start[k] = kept(made)
            comparing.advance(done)
    return Starts(depths, start, resolved, decision, judged)


def _gains_little(results: Sequence[DepthResult], decision: Decision) -> bool:
    """Whether photos that took no part say, of the first size, that smaller sizes are there in vain, though they were
    measured to be needed: cameras that are off, or a sensor's noise, look like depths that are far off."""
    moved = [result for result in results if not result.reason]     # refused ones may move at the next size
    shares = [after / before for result in moved for before, after in result.report.get("held_out_costs", ())
              if None not in (before, after) and before > 0 and np.isfinite(after)]        # NaN: it saw nothing then
    return len(shares) > 0 and not np.isnan(decision.evidence) and float(np.median(shares)) > _LITTLE
