"""One view: which effects it needs, the levels, and whether what came out is believed (method section 7)."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from logging import DEBUG, WARNING
from types import NoneType

import numpy as np
import numpy.typing as npt

from pagas_cl.config import Config
from pagas_cl.config.presets import settings_of
from pagas_cl.errors import check_kind, log
from pagas_cl.method.effects import decide
from pagas_cl.method.effects.decide import Decision
from pagas_cl.method.effects.measure import Measurements
from pagas_cl.method.splat import PhotoStore, Refinement, ViewInput, hypotheses_for, refine_levels
from pagas_cl.method.splat.budget import fit_memory
from pagas_cl.method.splat.hypotheses import is_enabled
from pagas_cl.method.view.acceptance import nothing_reason, rejection_reason, target_photo_reason
from pagas_cl.method.view.coarse_to_fine import through_sizes
from pagas_cl.method.view.resemblance import views_to_ask
from pagas_cl.progress import NONE, OnStep, Reporter, progress_of, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Device, open_device
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.inputs import checked_depth, depth_array
from pagas_cl.scene.view import SmallPhoto, View, check_apart, checked_views, smaller


def refine_depth(target: View, contexts: Sequence[View], depth: npt.ArrayLike, *, preset: str | None = None,
                 config: Config | None = None, device: str | Device | None = None, progress: Reporter = None,
                 held_out: Sequence[View] = (), photos: PhotoStore | None = None) -> DepthResult:
    """Refine the depth map of one view. Needs neither Open3D nor a mesh.

    Parameters
    ----------
    target : View
    contexts : list of View
        The views that constrain it.
    depth : array_like of shape (H, W)
        Initial z-depth in scene units; 0, negative or not finite = no surface. Of the size of the target's photo.
    held_out : sequence of View
        Views that take no part. Where one of their photos matches worse through the refined depth than through the
        initial one, the initial one stays; where what is left does not match them better on the whole, the view is
        returned unchanged, with the reason.
    photos : PhotoStore, optional
        Photos that are on the device already.
    progress : True, a function (stage, done, total), or a Progress, optional
        One stage, whose total is 1.
    device : str or Device, optional
        As in refine_mesh, but one.
    preset, config
        As in refine_mesh.

    Raises
    ------
    InputError, DeviceError
    """
    check_kind("target", target, (View,), "a pagas_cl.View")
    check_kind("device", device, (str, Device, NoneType), "the name of an OpenCL device")
    check_kind("photos", photos, (PhotoStore, NoneType), "a PhotoStore")
    contexts, held_out = checked_views("contexts", contexts), checked_views("held_out", held_out)
    check_apart(target, contexts, held_out)
    config, depth, device = settings_of(preset, config), checked_depth(depth, target), open_device(device)
    if not contexts:
        return DepthResult.unrefined(target.camera, depth, "no context views were given", name=target.name)
    photos, shown = photos or PhotoStore(device), progress_of(progress)
    views, depths = [target, *contexts], [depth, *[None] * len(contexts)]

    def refine_small(small: list[View], start: list[np.ndarray], config: Config, _: int,
                     scale: float) -> list[DepthResult]:
        judges = [smaller(view, scale) for view in held_out]
        return [_refined(ViewInput(small[0], small[1:], start[0], device, PhotoStore(device), judges), config)]

    with stage(shown, f"refine {target.name}", 1.0) as view:
        on_step = None if shown is NONE else lambda done, total: view.advance(done / total)
        starts = through_sizes(refine_small, views, depths, [0], config, lambda: photos)
        given = ViewInput(target, contexts, depth_array(starts.depths[0]), device, photos, held_out)
        result = _refined(given, starts.config, on_step)
    starts.log_moved([target], [result])
    decide.add_decision(result.report, starts.decision)
    return result


def refine_one(views: Sequence[View] | Mapping[int, View], partners: Partners, depth: npt.ArrayLike, config: Config,
               device: Device, photos: PhotoStore, on_step: OnStep | None = None) -> DepthResult:
    """One of many views, with the partners chosen for it: a pure function, which any worker may run. `views` by place:
    a list, or a dict with those that are needed. `on_step(done, total)` is a callback for each step that the device has
    done, of those of all levels."""
    target, depth = views[partners.target], checked_depth(depth, views[partners.target])
    if not partners.contexts:
        _log_unchanged(target, partners.reason)
        return DepthResult.unrefined(target.camera, depth, partners.reason, name=target.name)
    others = [views[k] for k in partners.all[1:]]
    given = ViewInput(target, others, depth, device, photos)
    kept, decision = views_to_ask(given, partners, config)
    given = replace(given, contexts=[views[k] for k in kept.contexts], held_out=[views[k] for k in kept.held_out])
    result = _refined(given, config, on_step)
    decide.add_decision(result.report, decision)
    result.report["left_out"] = [k for k in partners.all if k not in kept.all]         # by place: not all have names
    return result


def _log_unchanged(target: View, reason: str) -> None:
    """A warning, at full size alone: it goes on where a smaller one has not moved the view."""
    log.log(DEBUG if isinstance(target.image, SmallPhoto) else WARNING, "view %s stays unchanged: %s", target.name,
            reason)


def _with_hypotheses(given: ViewInput, refined: Refinement, config: Config, resolved: Config,
                     measured: Measurements | None) -> tuple[Refinement, Decision]:
    """`refined`, and where photos match badly under it what some more steps make of depths that they agree on, where
    there are enough; settings `config`, and as they are `resolved` for this view."""
    start = given.with_depth(refined.depth)
    with hypotheses_for(start, config) as hypotheses:
        places, found = hypotheses.search(*decide.least_found(config))
    normalized = start.normalized()
    normalized.release()
    decision = decide.decide_hypotheses(len(places) / refined.depth.size, config)
    if not decision.on:
        return refined, decision
    depth = refined.depth.copy()
    np.put(depth, places, (found.astype(np.float64) * normalized.scene_scale).astype(np.float32))
    again = refine_levels(given.with_depth(depth), decide.at_full_size(resolved, decide.AFTER_HYPOTHESES),
                          measured=measured)
    return refined.updated(again), decision


def _refined(given: ViewInput, config: Config, on_step: OnStep | None = None) -> DepthResult:
    start, searches, target = time.perf_counter(), is_enabled(config, len(given.contexts)), given.target

    def attempt(given: ViewInput) -> tuple[Refinement, list[Decision], Measurements | None]:
        with decide.resolve_effects(given, config) as (own, decisions, measured, used):
            refined = refine_levels(used, own, on_step=on_step, measured=measured)
            if searches:
                refined, decision = _with_hypotheses(used, refined, config, own, measured)
                decisions.append(decision)
        return refined, decisions, measured

    refined, decisions, measured = fit_memory(attempt, given, config)
    if not np.isnan(refined.mismatch):
        decisions.append(decide.decide_mismatch(refined.mismatch, config))
    reason = (rejection_reason(refined, given, measured) or nothing_reason(refined)
              or target_photo_reason(refined, given, measured))
    report = {"contexts": [view.name for view in given.contexts], "held_out": [view.name for view in given.held_out],
              "effects": [decision.as_dict() for decision in decisions], "steps": refined.steps, "cost": refined.cost,
              "held_out_costs": refined.held_out, "device_bytes": refined.device_bytes,
              "planned_bytes": refined.planned_bytes, "measured": measured.figures if measured else {},
              "seconds": time.perf_counter() - start}
    if not np.isnan(refined.resolved):
        report["resolved"] = refined.resolved
    if reason:
        _log_unchanged(target, reason)
        return DepthResult.unrefined(target.camera, given.depth, reason, report, target.name)
    return DepthResult(target.camera, refined.depth, refined.status, refined.deviation, refined.parallax, "", report,
                       target.name)
