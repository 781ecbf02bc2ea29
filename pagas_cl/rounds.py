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

from pagas_cl.config import MOST_WEIGHT, Config
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

    `results`: of the round before, the view's own first, then those of others, in memory or on disk (StoredResult),
    from where they are read when the device has to have them. The others are as in refine.refine_one.
    """
    return _averaged(_loaded(results[0]), results, config, device, photos, propose=False)


def _averaged(own: DepthResult, results: Sequence[DepthResult], config: Config, device: Device, photos: PhotoStore,
              propose: bool) -> DepthResult:
    """`own` is the first of `results` in memory; `propose`: also in place of depths that photos refused."""
    start = time.perf_counter()
    others = [result for result in results[1:] if not result.reason]
    if own.reason or not others:
        return own
    photos.trim(_BYTES * max(_pixels(result) for result in results))

    def owner(result: DepthResult) -> Any:
        given = results[0] if result is own else result
        return getattr(given, "identity", given)

    def send(result: DepthResult) -> tuple[Any, Any]:
        """Once for all views of a round that are compared with it, whose arrays are not looked at again."""
        return photos.held(owner(result), 8 * _pixels(result), lambda: _evidence(result).send(device))

    comparison = Agreement(own, others, device, send)
    spread = comparison.spread()
    decision = decide_agreement(spread, config)
    effects = [effect for effect in own.report.get("effects", ()) if effect["effect"] != decision.effect]
    report = {**own.report, "effects": [*effects, decision.as_dict()]}
    found = comparison.average(spread, config.agreement.pixels, propose) if decision.on else None
    if photos.on_host:          # where they would take the memory of all else
        photos.forget(map(owner, (own, *others)))
    if found is None:
        return replace(own, report=report)
    report["differences"] = [*own.report.get("differences", ()), spread]
    report["seconds"] = own.report.get("seconds", 0.0) + time.perf_counter() - start
    return replace(own, depth=found.depth, status=found.status, deviation=found.deviation, report=report)


def average_and_step(views: Sequence[View] | Mapping[int, View], partners: Partners, results: Sequence[DepthResult],
                     config: Config, device: Device, photos: PhotoStore,
                     progress: Progress | None = None) -> DepthResult:
    """The same, and then some steps of the photos, from there, which refuse what matches worse than it did."""
    steps = max(1, round(config.agreement.steps * config.pyramid.steps[-1])) if config.agreement.steps else 0
    kept = _loaded(results[0])
    averaged = _averaged(kept, results, config, device, photos, propose=steps > 0)
    if averaged.depth is kept.depth or not steps:
        return averaged
    start, target, contexts = time.perf_counter(), views[partners.target], [views[k] for k in partners.contexts]
    few = _few(config, steps, len(contexts), kept.report)
    stepped = _steps(target, contexts, kept.depth, averaged.depth, few, device, photos,
                     [views[k] for k in partners.held_out], progress)
    # what no view has spoken for, or the photos speak against, is as it was
    refined = (averaged.status == REFINED) & (stepped.status == REFINED)
    report = {**averaged.report, "seconds": averaged.report["seconds"] + time.perf_counter() - start}
    return replace(averaged, depth=np.where(refined, stepped.depth, kept.depth), parallax=stepped.parallax,
                   status=np.where(refined, stepped.status, kept.status),
                   deviation=np.where(refined, stepped.deviation, kept.deviation), report=report)


def _few(config: Config, steps: int, contexts: int, report: Mapping[str, Any]) -> Config:
    """The settings for so few steps from a depth that is nearly right: at full size, smoothness raised at once, for
    mismatch by what was measured (`report`). Photos that do not match anywhere around (solver.mismatch) do not tell one
    depth from another."""
    raised = [e["evidence"] for e in report.get("effects", ()) if e["effect"] == "mismatch" and e["on"]] or [1.0]
    weight = min(MOST_WEIGHT, config.smoothness.weight_with(contexts) * raised[0])
    return config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,), solver__early_damping=1.0,
                                smoothness__weight=weight, smoothness__full_views=1,
                                effects__pyramid="set", effects__mismatch="set", solver__mismatch=2.0)


def _steps(target: View, contexts: Sequence[View], depth: np.ndarray, start: np.ndarray, config: Config,
           device: Device, photos: PhotoStore, held_out: Sequence[View], progress: Progress | None) -> Any:
    from pagas_cl.splat import NormalizedDepth, refine_levels
    from pagas_cl.splat.budget import fit_memory

    told = (lambda done, total: progress(f"agree {target.name}", done, total)) if progress else None

    def attempt(photos: PhotoStore) -> Any:
        normalized = NormalizedDepth(target, depth, device)
        settled, _, measured = settle(target, contexts, depth, config, device, photos, normalized=normalized)
        if len(settled.pyramid.scales) > 1:      # asked for by noise, for a depth that is far off
            settled = settled.with_settings(pyramid__scales=(1.0,), pyramid__steps=config.pyramid.steps)
        return refine_levels(target, contexts, depth, settled, device, photos, progress=told, measured=measured,
                             normalized=normalized, start=start, held_out=held_out)

    return fit_memory(attempt, target, contexts, config, device, photos, held_out=held_out)


def _loaded(result: Any) -> DepthResult:
    """A result that may be on disk, in memory."""
    return result if isinstance(result, DepthResult) else result.loaded()


def _pixels(result: DepthResult) -> int:
    return result.camera.width * result.camera.height


def _evidence(result: DepthResult) -> DepthEvidence:
    return DepthEvidence(result.camera, result.depth, result.deviation, result.status, result.parallax)
