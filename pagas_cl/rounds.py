"""Rounds after the first, in which refined depth maps are evidence for one another (method section 8.1).

A round's result of a view is a pure function of its photos and of depth maps of the round before, its own and those of
its context views: rounds may be worked on by anybody, in any order of the views.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.effects import agreement_rounds, decide_agreement, settle
from pagas_cl.progress import Progress
from pagas_cl.result import DepthResult
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.view import View
from pagas_cl.surface.agreement import Agreement, DepthEvidence

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device
    from pagas_cl.splat import PhotoStore

_BYTES = 64     # a pixel: more than a comparison takes beside the photos that wait on the device
_LONGER = 1.4   # steps of a few: as far as half as many again would


@dataclass(frozen=True)
class Round:
    """One round: `work`, a function of a module as below, which any process finds; whether it looks at `photos`."""

    work: Callable[..., DepthResult]
    photos: bool


def later_rounds(config: Config, views: int) -> list[Round]:
    """What is done with each of so many views after all of them were refined."""
    rounds = agreement_rounds(config, views)
    return [Round(average_and_step, True)] * (rounds - 1) + [Round(average_depths, False)] * (rounds > 0)


def average_depths(views: Sequence[View] | Mapping[int, View], partners: Partners, results: Sequence[DepthResult],
                   config: Config, device: Device, photos: PhotoStore, progress: Progress | None = None) -> DepthResult:
    """One view's depths averaged with those of other views, where they see the same surface. What photos refused stays
    as it is: none is asked again.

    `results`: of the round before, the view's own first, then those of others. The others are as in refine.refine_one.
    """
    start, result = time.perf_counter(), results[0]
    found = _compared(results, config, device, photos, propose=False)
    if found is None:
        return result
    report, comparison, averaged = found
    arrays = {} if averaged is None else comparison.read(averaged)
    comparison.release()
    return replace(result, report=_took(report, start), **arrays)


def _compared(results: Sequence[DepthResult], config: Config, device: Device, photos: PhotoStore,
              propose: bool) -> tuple[dict[str, Any], Agreement, list[Any] | None] | None:
    """The report of the view's result with what it is told; the comparison with the others, the caller's to release,
    and what it leaves, None where nothing is averaged. `propose`: also in place of depths that photos refused. None
    where there is nothing to compare."""
    own, owners = results[0], {_evidence(result): result for result in results if not result.reason}
    if own.reason or len(owners) < 2:
        return None
    photos.trim(_BYTES * max(result.depth.size for result in results))

    def send(evidence: DepthEvidence) -> list[Any]:
        """Once for all views of a round that are compared with it."""
        return photos.held(owners[evidence], 17 * evidence.depth.size, lambda: evidence.send(device))

    mine, *others = owners
    comparison = Agreement(mine, others, device, send)
    spread = comparison.spread()
    decision = decide_agreement(spread, config)
    effects = [effect for effect in own.report.get("effects", ()) if effect["effect"] != decision.effect]
    report = {**own.report, "effects": [*effects, decision.as_dict()]}
    if not decision.on:
        return report, comparison, None
    report["differences"] = [*own.report.get("differences", ()), spread]
    return report, comparison, comparison.average(spread, config.agreement.pixels, propose)


def _took(report: dict[str, Any], start: float) -> dict[str, Any]:
    return {**report, "seconds": report.get("seconds", 0.0) + time.perf_counter() - start}


def average_and_step(views: Sequence[View] | Mapping[int, View], partners: Partners, results: Sequence[DepthResult],
                     config: Config, device: Device, photos: PhotoStore,
                     progress: Progress | None = None) -> DepthResult:
    """The same, and then some steps of the photos, from there, which refuse what matches worse than it did."""
    steps = max(1, round(config.agreement.steps * config.pyramid.steps[-1])) if config.agreement.steps else 0
    if not steps:
        return average_depths(views, partners, results, config, device, photos)
    start, result = time.perf_counter(), results[0]
    found = _compared(results, config, device, photos, propose=True)
    if found is None:
        return result
    report, comparison, averaged = found
    if averaged is not None:
        told = (lambda done, total: progress(f"agree {result.name}", done, total)) if progress else None
        stepped = _steps(views, partners, result, averaged[0], _few(config, steps, len(partners.contexts), report),
                         device, photos, told)
        # what no view has spoken for, or the photos speak against, is as it was
        refined = (comparison.read(averaged)["status"] == REFINED) & (stepped.status == REFINED)
        result = replace(result, parallax=stepped.parallax, **{
            name: np.where(refined, getattr(stepped, name), getattr(result, name))
            for name in ("depth", "status", "deviation")})
    comparison.release()
    return replace(result, report=_took(report, start))


def _few(config: Config, steps: int, contexts: int, report: Mapping[str, Any]) -> Config:
    """The settings for so few steps from a depth that is nearly right: at full size, smoothness raised at once, for
    mismatch by what was measured (`report`). Photos that do not match anywhere around (solver.mismatch) do not tell one
    depth from another."""
    mismatch = [e["evidence"] for e in report.get("effects", ()) if e["effect"] == "mismatch"] or [1.0]
    return config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,), solver__early_damping=1.0,
                                solver__rate=_LONGER * config.solver.rate,
                                smoothness__weight=config.smoothness.weight_with(contexts, mismatch[0]),
                                smoothness__full_views=1, effects__pyramid="set", effects__mismatch="set",
                                solver__mismatch=2.0)


def _steps(views: Sequence[View] | Mapping[int, View], partners: Partners, result: DepthResult, start: Any,
           config: Config, device: Device, photos: PhotoStore, told: Callable[[int, int], None] | None) -> Any:
    """From `start`, on the device, for what the view called for when it was refined, or calls for now."""
    from pagas_cl.splat import NormalizedDepth, refine_levels
    from pagas_cl.splat.budget import fit_memory

    target, contexts, held_out = views[partners.target], *(
        [views[k] for k in chosen] for chosen in (partners.contexts, partners.held_out))

    def attempt(photos: PhotoStore) -> Any:
        normalized = NormalizedDepth(target, result.depth, device)
        settled, _, measured = settle(target, contexts, result.depth, config, device, photos, normalized=normalized,
                                      known=result.report.get("measured"))
        if len(settled.pyramid.scales) > 1:      # asked for by noise, for a depth that is far off
            settled = settled.with_settings(pyramid__scales=(1.0,), pyramid__steps=config.pyramid.steps)
        return refine_levels(target, contexts, result.depth, settled, device, photos, progress=told, measured=measured,
                             normalized=normalized, start=start, held_out=held_out)

    return fit_memory(attempt, target, contexts, config, device, photos, held_out=held_out)


def _evidence(result: DepthResult) -> DepthEvidence:
    return DepthEvidence(result.camera, result.depth, result.deviation, result.status, result.parallax)
