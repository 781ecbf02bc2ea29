"""Rounds after the first, in which refined depth maps are evidence for one another (method section 8.1).

A round's result of a view is a pure function of its photos and of depth maps of the round before, its own and those of
its context views: rounds may be worked on by anybody, in any order of the views."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.config.stages import MOST_WEIGHT
from pagas_cl.errors import DeviceMemoryError
from pagas_cl.method.effects import decide
from pagas_cl.method.effects.measure import Measurements
from pagas_cl.method.splat import PhotoStore, ViewInput, edges, refine_levels, resolve_edges
from pagas_cl.method.splat.budget import fit_memory
from pagas_cl.method.splat.units import NormalizedDepth, Start, WhenNeeded, room_for
from pagas_cl.method.surface.agreement import Agreement, DeviceMaps, send
from pagas_cl.progress import OnStep
from pagas_cl.result import DepthResult, RoundInput
from pagas_cl.runtime.device import Device
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.view import View

_BYTES = 64 + edges.NBYTES     # a pixel: more than a comparison takes in addition to the photos that wait on the device
_ARRAYS = "depth", "parallax", "deviation", "status"
_LONGER = 1.4   # steps of a few: as far as half as many again would


def keep(owner: Any, result: DepthResult, device: Device, photos: PhotoStore) -> None:
    """Have what views of the next round compare with stay on a device that has memory of its own."""
    if result.reason or photos.on_host:
        return
    photos.replace([result], [owner])           # where its round has left it there
    with suppress(DeviceMemoryError):           # it is read again, then
        _on_device(owner, result, device, photos)


def _on_device(owner: Any, result: DepthResult, device: Device, photos: PhotoStore, whole: bool = False) -> DeviceMaps:
    """`result` on the device, where it may be already; all of it where that has memory of its own."""
    whole = whole or not photos.on_host
    return photos.held(owner, DeviceMaps.nbytes(result.camera.size.pixels, whole), lambda: send(result, device, whole))


def later_rounds(config: Config, views: int) -> list[Callable[..., DepthResult]]:
    """What is done with each of so many views after all of them were refined, round by round."""
    rounds = decide.agreement_rounds(config, views)
    return [average_and_step] * (rounds - 1) + [average_depths] * (rounds > 0)


def average_depths(views: Sequence[View] | Mapping[int, View], partners: Partners, given: Sequence[RoundInput],
                   config: Config, device: Device, photos: PhotoStore, on_step: OnStep | None = None,
                   steps: Config | None = None) -> DepthResult:
    """One view's depths averaged with those of other views, where they see the same surface; then pixels next to edges
    get the surface that they show (method section 8.4). What photos refused stays as it is but there: none is judged
    again. With `steps`, settings of some: see average_and_step. `given`: of the round before, the view's own first, in
    memory, then those of others, which are read when the device has to have them. The other parameters are as in
    one_view.refine_one."""
    own, others = given[0].result, [one.result for one in given[1:] if not one.result.reason]
    owners = {id(one.result): one.identity for one in given}
    start, found = time.perf_counter(), {}
    if own.reason or not others:
        return own
    room = room_for(own.depth.shape)
    photos.trim(_BYTES * max(one.result.camera.size.pixels for one in given))
    # once for all views of a round that are compared with it, whose arrays are not looked at again
    comparison = Agreement(own, others, device, lambda result, whole: _on_device(
        owners[id(result)], result, device, photos, whole))
    spread = comparison.spread()
    decision = decide.decide_agreement(spread, config)
    report = {**own.report}
    decide.add_decision(report, decision)
    spreads = [*own.report.get("differences", ()), spread]
    averaged, seen_at = None, partial(_view_input, views, partners, own, device, photos)
    if decision.on and (steps is None or decide.needs_steps(spread, config)):
        averaged = comparison.average(spread, config.agreement.pixels, steps is not None, spreads[0])
        report["differences"] = spreads
        if steps is None:
            known = {**averaged, "parallax": comparison.maps.parallax, "own_depth": comparison.maps.depth}
            fit_memory(lambda view: resolve_edges(view, config, known, comparison.count_support),
                       seen_at(averaged["depth"]), config)
    if photos.on_host:          # where they would take the memory of all else
        photos.forget(owners[id(other)] for other in others)
    if averaged is not None:
        if steps is not None:
            stepped, left = _steps(seen_at(comparison.maps.depth), comparison, averaged,
                                   _few(steps, len(report["contexts"])), on_step, room.result)
            found = {name: getattr(stepped, name) for name in _ARRAYS}
        else:
            found = comparison.read(averaged, dict(zip(_ARRAYS, room.result())))
    comparison.release()
    report["seconds"] = report.get("seconds", 0.0) + time.perf_counter() - start
    result = replace(own, report=report, **found)
    if photos.on_host:
        photos.forget([owners[id(own)]])
    elif averaged is not None and steps is not None:        # for the next round
        photos.held(result, DeviceMaps.nbytes(own.camera.size.pixels, True), lambda: left)
    return result


def average_and_step(views: Sequence[View] | Mapping[int, View], partners: Partners, given: Sequence[RoundInput],
                     config: Config, device: Device, photos: PhotoStore, on_step: OnStep | None = None) -> DepthResult:
    """The same, in place of refused depths too, and then some steps of the photos, which refuse what matches worse."""
    return average_depths(views, partners, given, config, device, photos, on_step, decide.between_rounds(config))


@lru_cache(16)
def _few(config: Config, contexts: int) -> Config:
    """Settings of so few steps, from a depth that is nearly right: smoothness raised at once. Photos that do not match
    anywhere around (solver.mismatch) do not distinguish one depth from another."""
    return config.with_settings(solver__early_damping=1.0, solver__rate=min(100.0, _LONGER * config.solver.rate),
                                smoothness__weight=config.smoothness.weight_with(contexts),
                                smoothness__full_views=1, smoothness__early=1.0, solver__mismatch=2.0,
                                effects__pyramid="set", effects__mismatch="set")


def _view_input(views: Sequence[View] | Mapping[int, View], partners: Partners, result: DepthResult, device: Device,
                photos: PhotoStore, depth: Any) -> ViewInput:
    """The view with those that resemble it, and its `depth`, which is on the device."""
    target, contexts, held_out = views[partners.target], *(
        [views[k] for k in chosen if k not in result.report["left_out"]]
        for chosen in (partners.contexts, partners.held_out))
    return ViewInput(target, contexts, result.depth, device, photos, held_out, WhenNeeded(lambda: NormalizedDepth(
        target, result.depth, device, depth, result.scene_scale)))


def _steps(given: ViewInput, comparison: Agreement, averaged: Mapping[str, Any], config: Config,
           on_step: OnStep | None, into: Callable[[], list[np.ndarray]]) -> tuple[Any, DeviceMaps]:
    """From what was `averaged`, some steps with the effects that the view had or needs; and the same on the device."""
    result, left = comparison.own, []
    if any(effect["effect"] == "shading" and effect["on"] for effect in result.report["effects"]):
        config = decide.shaded(config)
    elif config.effects.shading == "auto":
        config = config.with_settings(effects__shading="off")

    def agreed(*found: Any) -> tuple[Any, ...]:
        left[:] = [comparison.agreed(averaged["status"], *found)]
        return left[0].depth, left[0].parallax, left[0].deviation, left[0].status

    figures = result.report.get("measured")         # under an earlier depth
    known = Measurements(**figures) if figures else None
    start = Start(averaged["depth"], agreed, DeviceMaps.nbytes(result.camera.size.pixels, True), into)

    def attempt(given: ViewInput) -> Any:
        with decide.resolve_effects(given, config, known if known and known.lasting else None) as (
                own, decisions, measured, used):
            share = decide.left_to_smooth(decisions, len(comparison.others), measured)
            own = own.with_settings(         # at full size, whatever noise requires, or a depth that is far off
                pyramid__scales=(1.0,), pyramid__steps=config.pyramid.steps,
                solver__gradient_filter=decide.filter_between(result.report.get("resolved", float("nan")),
                                                              len(comparison.others), config),
                smoothness__weight=min(MOST_WEIGHT, share * own.smoothness.weight))
            return refine_levels(used, own, on_step=on_step, measured=measured, start=start)

    return fit_memory(attempt, given, config), left[0]
