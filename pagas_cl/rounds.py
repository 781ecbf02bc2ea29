"""Rounds after the first, in which refined depth maps are evidence for one another (method section 8.1).

A round's result of a view is a pure function of its photos and of depth maps of the round before, its own and those of
its context views: rounds may be worked on by anybody, in any order of the views.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

from pagas_cl.config import MOST_WEIGHT, Config
from pagas_cl.effects import (
    agreement_rounds,
    between_rounds,
    decide_agreement,
    filter_between,
    left_to_smooth,
    settle,
    shaded,
)
from pagas_cl.errors import DeviceMemoryError
from pagas_cl.measurements import Measurements
from pagas_cl.progress import Progress
from pagas_cl.result import DepthResult
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.view import View
from pagas_cl.surface.agreement import Agreement, Told, send

if TYPE_CHECKING:
    import numpy as np

    from pagas_cl.runtime.device import Device
    from pagas_cl.splat import PhotoStore

_BYTES = 64     # a pixel: more than a comparison takes beside the photos that wait on the device
_ARRAYS = "depth", "parallax", "deviation", "status"
_LONGER = 1.4   # steps of a few: as far as half as many again would


def keep(owner: Any, result: DepthResult, device: Device, photos: PhotoStore) -> None:
    """Have what views of the next round ask for stay on a device that has memory of its own."""
    if result.reason or photos.on_host:
        return
    photos.replace([result], [owner])           # where its round has left it there
    with suppress(DeviceMemoryError):           # it is read again, then
        _told(owner, result, device, photos)


def _told(owner: Any, result: DepthResult, device: Device, photos: PhotoStore, whole: bool = False) -> Told:
    """`result` on the device, where it may be already; all of it where that has memory of its own."""
    whole = whole or not photos.on_host
    return photos.held(owner, Told.nbytes(_pixels(result), whole), lambda: send(result, device, whole))


def _take_back(result: DepthResult, device: Device, told: Told) -> None:
    """Give `result` new arrays with what the device was told of it: its own serve another one."""
    from pagas_cl.runtime.memory import download

    for name in _ARRAYS:
        array = getattr(result, name)
        object.__setattr__(result, name, download(device, getattr(told, name), array.shape, array.dtype))


@dataclass(frozen=True)
class Round:
    """One round: `work`, a function of a module as below, which any process finds; whether it looks at `photos`; and
    `keep`, what is done with each result of the round before it."""

    work: Callable[..., DepthResult]
    photos: bool
    keep: Callable[..., None] = keep


def later_rounds(config: Config, views: int) -> list[Round]:
    """What is done with each of so many views after all of them were refined."""
    rounds = agreement_rounds(config, views)
    return [Round(average_and_step, True)] * (rounds - 1) + [Round(average_depths, False)] * (rounds > 0)


def average_depths(views: Sequence[View] | Mapping[int, View], partners: Partners, results: Sequence[DepthResult],
                   config: Config, device: Device, photos: PhotoStore, progress: Progress | None = None,
                   steps: Config | None = None, reuse: bool = False) -> DepthResult:
    """One view's depths averaged with those of other views, where they see the same surface. What photos refused stays
    as it is: none is asked again. With `steps`, settings of some: see average_and_step.

    `results`: of the round before, the view's own first, then those of others, in memory or on disk (StoredResult),
    from where they are read when the device has to have them. `reuse`: what this leaves has the arrays of the view's
    own one, on a device with memory of its own, which holds what others ask of it: the system takes as long to give new
    memory as a round takes. The others are as in one_view.refine_one.
    """
    from pagas_cl.splat.units import room_for

    own, *others = results[0], *(result for result in results[1:] if not result.reason)
    own = own if isinstance(own, DepthResult) else own.loaded()         # it may be on disk
    start, found = time.perf_counter(), {}
    if own.reason or not others:
        return own
    promised = None if reuse and not photos.on_host else room_for(own.depth.shape)
    photos.trim(_BYTES * max(_pixels(result) for result in results))

    def owner(result: Any) -> Any:
        given = results[0] if result is own else result
        return getattr(given, "identity", given)

    # once for all views of a round that are compared with it, whose arrays are not looked at again
    comparison = Agreement(own, others, device,
                           lambda result, whole: _told(owner(result), result, device, photos, whole))
    spread = comparison.spread()
    decision = decide_agreement(spread, config)
    effects = [effect for effect in own.report.get("effects", ()) if effect["effect"] != decision.effect]
    report = {**own.report, "effects": [*effects, decision.as_dict()]}
    spreads = [*own.report.get("differences", ()), spread]
    averaged = comparison.average(spread, config.agreement.pixels, steps is not None,
                                  spreads[0]) if decision.on else None
    if photos.on_host:          # where they would take the memory of all else
        photos.forget(map(owner, others))
    if averaged is not None:
        report["differences"] = spreads
        held = promised is None and photos.on_leaving(own, partial(_take_back, own, device))
        into = partial(_arrays_of, own) if held else (promised or room_for(own.depth.shape)).result
        if steps is not None:
            told = (lambda done, total: progress(f"agree {own.name}", done, total)) if progress else None
            few = _few(steps, len(report["contexts"]))
            stepped, left = _steps(views, partners, comparison, averaged, few, device, photos, told, into)
            found = {name: getattr(stepped, name) for name in _ARRAYS}
        else:
            found = comparison.read(averaged, dict(zip(_ARRAYS, into())))
    comparison.release()
    report["seconds"] = report.get("seconds", 0.0) + time.perf_counter() - start
    result = replace(own, report=report, **found)
    if photos.on_host:
        photos.forget([owner(own)])
    elif averaged is not None and steps is not None:        # for the next round
        photos.held(result, Told.nbytes(_pixels(own), True), lambda: left)
    return result


def average_and_step(views: Sequence[View] | Mapping[int, View], partners: Partners, results: Sequence[DepthResult],
                     config: Config, device: Device, photos: PhotoStore, progress: Progress | None = None,
                     reuse: bool = False) -> DepthResult:
    """The same, also in place of depths that photos refused, and then some steps of the photos, from there, which
    refuse what matches worse than it did."""
    return average_depths(views, partners, results, config, device, photos, progress, between_rounds(config), reuse)


@lru_cache(16)
def _few(config: Config, contexts: int) -> Config:
    """Settings of so few steps, from a depth that is nearly right: smoothness raised at once. Photos that do not match
    anywhere around (solver.mismatch) do not tell one depth from another."""
    return config.with_settings(solver__early_damping=1.0, solver__rate=min(100.0, _LONGER * config.solver.rate),
                                smoothness__weight=config.smoothness.weight_with(contexts),
                                smoothness__full_views=1, smoothness__early=1.0, solver__mismatch=2.0,
                                effects__pyramid="set", effects__mismatch="set")


def _steps(views: Sequence[View] | Mapping[int, View], partners: Partners, comparison: Agreement,
           averaged: Mapping[str, Any], config: Config, device: Device, photos: PhotoStore,
           told: Callable[[int, int], None] | None, into: Callable[[], list[np.ndarray]]) -> tuple[Any, Told]:
    """From what was `averaged`, for what the view called for when it was refined, or calls for now; and the same on the
    device."""
    from pagas_cl.splat import NormalizedDepth, refine_levels
    from pagas_cl.splat.budget import fit_memory
    from pagas_cl.splat.units import Start

    result, left = comparison.own, []
    if any(effect["effect"] == "shading" and effect["on"] for effect in result.report["effects"]):
        config = shaded(config)
    elif config.effects.shading == "auto":
        config = config.with_settings(effects__shading="off")
    target, contexts, held_out = views[partners.target], *(
        [views[k] for k in chosen if k not in result.report["left_out"]]         # those that resemble it
        for chosen in (partners.contexts, partners.held_out))

    def agreed(*found: Any) -> tuple[Any, ...]:
        left[:] = [comparison.agreed(averaged["status"], *found)]
        return left[0].depth, left[0].parallax, left[0].deviation, left[0].status

    figures = result.report.get("measured")         # under an earlier depth
    known = Measurements(**figures) if figures else None
    start = Start(averaged["depth"], agreed, Told.nbytes(_pixels(result), True), into)

    def attempt(photos: PhotoStore) -> Any:
        normalized = NormalizedDepth(target, result.depth, device, comparison.told.depth, result.scene_scale)
        with settle(target, contexts, result.depth, config, device, photos, normalized=normalized,
                    known=known if known and known.lasting else None) as (own, decisions, measured, used):
            share = left_to_smooth(decisions, len(comparison.others), measured)
            own = own.with_settings(         # at full size, whatever noise asks for, or a depth that is far off
                pyramid__scales=(1.0,), pyramid__steps=config.pyramid.steps,
                solver__gradient_filter=filter_between(result.report.get("resolved", float("nan")),
                                                       len(comparison.others), config),
                smoothness__weight=min(MOST_WEIGHT, share * own.smoothness.weight))
            return refine_levels(target, used, result.depth, own, device, photos, progress=told, measured=measured,
                                 normalized=normalized, start=start, held_out=held_out)

    return fit_memory(attempt, target, contexts, config, device, photos, held_out=held_out), left[0]


def _arrays_of(result: DepthResult) -> list[np.ndarray]:
    return [getattr(result, name) for name in _ARRAYS]


def _pixels(result: DepthResult) -> int:
    return result.camera.width * result.camera.height
