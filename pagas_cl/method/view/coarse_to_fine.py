"""The effect `pyramid` (method section 8.3): where a start is far off, all views of a scene are refined at smaller
sizes first, each size from what the one before it has found."""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import DeviceError, InputError, log
from pagas_cl.method.effects.decide import Decision
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore
from pagas_cl.progress import Progress, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import stretched_depth, taps
from pagas_cl.scene.inputs import Depth, depth_array
from pagas_cl.scene.sampling import sample_depth
from pagas_cl.scene.smaller import smaller
from pagas_cl.scene.view import View, joined

FAR_OFF = 0.05           # share of samples, see far_off, above which smaller sizes come first: near starts have up to
                         # 0.03 on made scenes, where photos are noisy, those a pixel or more off 0.1 and more
_LOOKED_AT, _AT = 4, 0.5     # views that are measured to know whether the start is far off, and the size they have
_EARLY = 0.33            # smoothness.early at these sizes: how far steps reach, smoothness decides
_LEFT, _TAKEN = 0.5, 1.0 # pixels of parallax at full size: a depth that moved by less is left to the steps there, one
                         # that moved by more is taken whole
_AROUND = 3              # pixels of a smaller size to each side, over which it moves as those do that are sure
_SUREST = 0.1            # pixels of parallax there: no depth counts for more than one of this deviation,
_UNSURE = 1e-3           # and one that photos do not confirm for so little, in 1 / squared pixels;
_OWN = 100.0             # times that a pixel itself counts: more leaves single depths astray, less blurs what moves
_ROWS = 64               # of a depth map that are made at a time


@dataclass(frozen=True, eq=False)
class Movement:
    """What a smaller size, `scale` of the full one, has found: the `result` there, and the depth map (h, w) as it was
    `given`, at that size, before any size was refined."""

    given: Depth
    result: DepthResult
    scale: float


Refine: TypeAlias = Callable[[list[View], list[Any], Config, int, float], list[DepthResult]]
"""Refines depth maps: views, depth maps and settings of a size; its place in the row of sizes, from 0, and the size."""


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
    decision = decide_pyramid(evidence, config)
    log.debug("%s", decision)
    full = replace(config, effects=replace(config.effects, pyramid="set"))
    return config.pyramid.far_off if decision.on else (), full, decision


def decide_pyramid(evidence: float, config: Config) -> Decision:
    """Whether smaller sizes come first, by what `far_off` says."""
    choice = config.effects.pyramid
    reason = "share of samples that match two or more pixels away at half size"
    return Decision("pyramid", evidence, FAR_OFF, choice == "on" or (choice == "auto" and evidence > FAR_OFF),
                    reason if choice == "auto" else f"requested: {choice}")


def far_off(views: Sequence[View], depths: Sequence[Depth | None], requested: Collection[int], config: Config,
            photos: PhotoStore) -> float:
    """Share of samples that match clearly better two or more pixels away, at half size: mean of a few of the views
    `requested`; 0 where none of these has context views. `photos` keeps theirs. A photo that cannot be read is left
    out: that is said where its view is refined."""
    few = list(requested)[::-(-len(requested) // _LOOKED_AT)]
    known = {k: depth_array(depths[k]) for k in few}
    samples = [sample_depth(known[k]) if k in known else None for k in range(len(views))]
    chooser = ContextChooser([view.camera for view in views], samples, config.context)

    def of(k: int) -> float:
        contexts = [views[j] for j in chooser.choose(k).indices]
        return measure(views[k], contexts, known[k], config, photos.device, photos,
                       scale=_AT).depth_far_off if contexts else 0.0

    found: list[float] = []
    for k in few:
        with suppress(InputError):
            found.append(of(k))
    return float(np.mean(found)) if found else 0.0


def through_sizes(refine: Refine, views: Sequence[View], depths: Sequence[Depth | None], requested: Collection[int],
                  config: Config, sizes: Sequence[float],
                  keep: Callable[[np.ndarray], Any] | None = None) -> list[Any]:
    """`depths`, those of the views `requested` moved along with what `refine` finds at one of the smaller `sizes` after
    the other; `keep` replaces a depth map by what stands for it. `config` as of resolve_pyramid."""
    config = config.with_settings(smoothness__early=min(config.smoothness.early, _EARLY), pyramid__scales=(1.0,),
                                  pyramid__steps=config.pyramid.steps[-1:])
    found: dict[int, Movement] = {}
    given: dict[int, Any] = {}      # the depths at a size, as they were before any was refined

    def kept(depth: np.ndarray) -> Any:
        return keep(depth) if keep else depth

    def moved(k: int, source: Depth | None) -> Any:
        return kept(moved_along(depth_array(source), found[k])) if k in found else source

    for number, scale in enumerate(sizes):
        small = [smaller(view, scale) for view in views]

        def shrunk(k: int, small: list[View] = small) -> Any:
            return kept(stretched_depth(depth_array(depths[k]), small[k].camera.width, small[k].camera.height))

        if number == 0 or scale != sizes[number - 1]:
            given = dict(zip(requested, side_by_side(shrunk, requested)))
        start: list[Any] = [None] * len(views)
        for k, depth in zip(given, side_by_side(lambda pair: moved(*pair), given.items())):
            start[k] = depth
        if not any((depth_array(start[k]) > 0).any() for k in requested):       # too small a surface for this size
            continue
        for k, result in joined(small, refine(small, start, config, number, scale)):
            if not result.reason:
                found[k] = Movement(given[k], result, scale)
    out = [*depths]
    for k, depth in zip(found, side_by_side(lambda k: moved(k, depths[k]), found)):
        out[k] = depth
    return out


class JudgedFirst:
    """What photos that took no part say of the depths that were given: at full size they judge those that smaller sizes
    have left."""

    def __init__(self) -> None:
        self._costs: dict[str, dict[str, Any]] = {}

    def noted(self, scale: float, results: list[DepthResult]) -> list[DepthResult]:
        """`results` at `scale` of the size, of which the first ones of each view are remembered."""
        for result in results:
            costs = result.report.get("held_out_costs", ())
            kept = [(before, before) for before, _ in costs] if result.reason else costs
            self._costs.setdefault(result.name, {"scale": scale, "held_out_costs": kept})
        return results

    def added_to(self, result: DepthResult) -> DepthResult:
        """`result` at full size, with them in its report."""
        if result.name in self._costs:
            result.report["smaller_sizes"] = self._costs[result.name]
        return result


def moved_along(depth: np.ndarray, movement: Movement) -> np.ndarray:
    """A depth map as it was given, of any size (H, W), moved along with what a smaller size has found: each depth by
    the share by which those around it moved that were of the same surface, within a pixel of parallax there."""
    given, near, share = _moves(movement)
    height, width = depth.shape
    x, y = ((np.arange(n) + 0.5) * small / n for n, small in ((width, given.shape[1]), (height, given.shape[0])))
    # columns first, since whole rows are copied faster than single pixels
    across = [(by_column.astype(np.float32), [values[:, columns] for values in (given, near, share)])
              for columns, by_column in taps(x, given.shape[1])]
    out = np.empty_like(depth, np.float32)
    for first in range(0, height, _ROWS):
        own = depth[first:first + _ROWS]
        total, weight = np.zeros(own.shape, np.float32), np.zeros(own.shape, np.float32)
        for rows, by_row in taps(y[first:first + _ROWS], given.shape[0]):
            for by_column, (of_given, of_near, of_share) in across:
                reached = np.abs(of_given[rows] - own) < of_near[rows]
                part = reached * by_column
                part *= by_row[:, None].astype(np.float32)
                weight += part
                part *= of_share[rows]
                total += part
        out[first:first + _ROWS] = own * (1 + total / np.where(weight > 0, weight, np.float32(1)))
    return out


def _moves(movement: Movement) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a smaller size, (h, w) float32: depths as they were given, a pixel of parallax there, and by which share of
    the depth the surface moved."""
    given, result = depth_array(movement.given), movement.result
    there = (given > 0) & (result.depth > 0) & (result.parallax > 0)
    unit, own = (np.where(there, one, np.float32(1)) for one in (result.parallax, given))
    near, share = np.where(there, unit, np.float32(0)), np.where(there, result.depth - given, np.float32(0)) / own
    deviation = np.maximum(result.deviation / unit, np.float32(_SUREST))
    share = _as_sure_ones(given, near, share, np.where(there, np.maximum(deviation**-2, np.float32(_UNSURE)), 0))
    pixels = np.abs(share) * own / (movement.scale * unit)
    return given, near, share * np.clip((pixels - _LEFT) / (_TAKEN - _LEFT), 0, 1)


def _as_sure_ones(given: np.ndarray, parallax: np.ndarray, share: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Mean of `share` (h, w) over the surroundings, of the same surface, weighted by how `sure` each is: what is sure
    stays nearly as it is. Next to an edge smaller photos show both sides, and single depths go astray."""
    height, width = given.shape
    depths, values, weights = (np.pad(one.astype(np.float32), _AROUND) for one in (given, share * sure, sure))
    total, weight = np.float32(_OWN) * share * sure, np.float32(_OWN) * sure
    for row in range(2 * _AROUND + 1):
        for column in range(2 * _AROUND + 1):
            at = np.s_[row:row + height, column:column + width]
            same = np.abs(depths[at] - given) < parallax
            total += values[at] * same
            weight += weights[at] * same
    return np.where(weight > 0, total / np.where(weight > 0, weight, np.float32(1)), share)
