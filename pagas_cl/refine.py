"""The method on one page (arXiv 2604.22129): photos, cameras and a coarse surface in, a finer surface out."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.config import preset as named_preset
from pagas_cl.effects import decide, measure
from pagas_cl.errors import InputError
from pagas_cl.keep_mesh import check_subdivide, displaced_mesh
from pagas_cl.result import DepthResult
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.inputs import as_views
from pagas_cl.scene.mesh import from_surface, to_surface
from pagas_cl.scene.view import View

log = logging.getLogger("pagas_cl")


def refine_mesh(mesh, cams, images, *, masks=None, preset="balanced", config=None, device=None, progress=None,
                output="tsdf", subdivide=None):
    """Refine a mesh with calibrated photos.

    mesh -> depth of every view -> refine each view by itself -> keep what other views confirm -> TSDF -> mesh
    (method section 7).

    Parameters
    ----------
    mesh : Open3D TriangleMesh (legacy or tensor), pymeshlab.Mesh, (vertices, faces), Surface, or the path of a file
    cams : list of Camera, Open3D PinholeCameraTrajectory, or pycolmap Reconstruction
    images : list of arrays (H, W, 3) (uint8, or floating point from 0 to 1) or paths, one a camera, or a folder
    masks : list of arrays (H, W) bool or paths, optional
        True = keep; applied to the target and to the context views.
    preset : str
        Name of the settings to start from; `config` (a Config) replaces them.
    device : str, optional
        Part of the name of an OpenCL device; a GPU before a CPU by default.
    progress : callable of (stage, done, total), optional
    output : str
        "tsdf": a new mesh, fused from the refined depth maps. "displace": the given mesh with its vertices moved onto
        depths that at least two views agree on; topology, texture coordinates and attributes stay.
    subdivide : float, optional
        With "displace": first split edges longer than this many pixel footprints.

    Returns
    -------
    A mesh of the kind that came in; with "tsdf", new colours and normals. (A path gives a Surface, with "displace" an
    Open3D mesh.)

    Raises
    ------
    InputError, DeviceError, MissingExtraError
    """
    if output not in ("tsdf", "displace"):
        raise InputError(f"output is {output!r}, expected 'tsdf' or 'displace'")
    check_subdivide(subdivide)
    config = _config(preset, config)
    views = as_views(cams, images, masks)
    surface = to_surface(mesh)
    depths = initial_depths(surface, views, progress)
    results = refine_views(views, depths, config=config, device=device, progress=progress)
    if output == "displace":
        return displaced_mesh(mesh, views, depths, results, config, subdivide)
    return from_surface(fuse_results(views, results, config, progress), like=mesh)


def refine_depth(target: View, contexts: list[View], depth, *, preset="balanced", config=None, device=None,
                 progress=None, witness: View | None = None, photos=None) -> DepthResult:
    """Refine the depth map of one view. Needs neither Open3D nor a mesh.

    Parameters
    ----------
    target : View
    contexts : list of View
        The views that constrain it.
    depth : array_like of shape (H, W)
        Initial z-depth in scene units; 0, negative or not finite = no surface. Of the size of the target's photo.
    witness : View, optional
        A view that takes no part; where its photo matches worse through the refined depth than through the initial
        one, the view is returned as it came, with the reason.
    photos : PhotoStore, optional
        Photos that are on the device already.
    preset, config, device, progress
        As in refine_mesh.
    """
    from pagas_cl.runtime.device import open_device
    from pagas_cl.splat import PhotoStore, refine_levels

    config, depth, device = _config(preset, config), _checked_depth(depth, target), open_device(device)
    if not contexts:
        return DepthResult.unrefined(target.camera, depth, "no context views were given")
    start, photos = time.perf_counter(), photos or PhotoStore(device)
    config, decisions, exposure = settle(target, contexts, depth, config, device, photos)
    refined = refine_levels(target, contexts, depth, config, device, photos, _steps_of(progress, target), witness,
                            exposure)
    report = {"contexts": [view.name for view in contexts], "witness": witness.name if witness else None,
              "effects": [decision.as_dict() for decision in decisions], "steps": refined.steps, "cost": refined.cost, "witness_cost": refined.witness,
              "device_bytes": refined.device_bytes, "seconds": time.perf_counter() - start}
    harm = _harm(refined, witness)
    if harm:
        log.warning("view %s is kept as it came: %s", target.name, harm)
        return DepthResult.unrefined(target.camera, depth, harm, report)
    return DepthResult(target.camera, refined.depth, refined.status, refined.deviation, refined.parallax, "", report)


def refine_views(views: list[View], depths, *, names=None, config=None, preset="balanced", device=None, progress=None,
                 on_view=None) -> list[DepthResult]:
    """Refine the depth maps of many views, each by itself.

    Parameters
    ----------
    views : list of View
    depths : list of arrays (H, W), one a view; None where a view has none
        Initial z-depth in scene units, 0 = no surface.
    names : collection of str, optional
        Views to refine; all that have a depth map by default. The others are context views still.
    on_view : callable of (view, initial depth, DepthResult), optional
        Called as soon as a view is finished; what it returns is dropped.

    Returns
    -------
    list of DepthResult, in the order of the views that were asked for
    """
    from pagas_cl.runtime.device import open_device
    from pagas_cl.splat import PhotoStore

    config, device = _config(preset, config), open_device(device)
    asked = _asked(views, depths, names)
    photos, results = PhotoStore(device), []
    one_more = replace(config.context, number=config.context.number + 1)
    chooser = ContextChooser([view.camera for view in views], depths, one_more)
    for done, index in enumerate(asked):
        if progress:
            progress("refine", done, len(asked))
        target, depth = views[index], _checked_depth(depths[index], views[index])
        chosen, witness, reason = _contexts(chooser.choose(index), config.context.number)
        if chosen:
            result = refine_depth(target, [views[k] for k in chosen], depth, config=config, device=device, photos=photos,
                                  witness=None if witness is None else views[witness])
        else:
            log.warning("view %s is kept as it came: %s", target.name, reason)
            result = DepthResult.unrefined(target.camera, depth, reason)
        results.append(result)
        if on_view:
            on_view(target, depth, result)
    if progress:
        progress("refine", len(asked), len(asked))
    return results


def settle(target: View, contexts: list[View], depth, config: Config, device, photos):
    """Decide which effects this view calls for: the settings that follow, the decisions, the exposure of each view."""
    if all(choice in ("set", "off") for choice in vars(config.effects).values()) and not config.loss.exposure:
        return *decide(config, None), None
    measured = measure(target, contexts, depth, config, device, photos)
    config, decisions = decide(config, measured)
    for decision in decisions:
        log.debug("view %s: %s %s (%.4g, threshold %.4g)", target.name, decision.effect, "on" if decision.on else "off",
                  decision.evidence, decision.threshold)
    return config, decisions, measured.exposure if config.loss.exposure else None


def initial_depths(surface, views: list[View], progress=None) -> list[np.ndarray]:
    """Depth of every view from the surface, by ray casting: float32 of shape (H, W), 0 = no surface."""
    from pagas_cl.scene.check import check_seen
    from pagas_cl.surface.raster import each_depth

    cameras, depths = [view.camera for view in views], []
    check_seen(surface, cameras)
    for depth in each_depth(surface, cameras):
        depths.append(depth)
        if progress:
            progress("render the mesh", len(depths), len(cameras))
    return depths


def fuse_results(views: list[View], results: list[DepthResult], config: Config, progress=None):
    """Keep what other views confirm, then TSDF: a Surface."""
    from pagas_cl.surface.agree import confirmed
    from pagas_cl.surface.fuse import fuse

    by_camera = {id(result.camera): result for result in results}
    used = [view for view in views if id(view.camera) in by_camera]
    depths = [by_camera[id(view.camera)].depth for view in used]
    agreed = confirmed([view.camera for view in used], depths, config.fusion)
    return fuse(used, agreed, config.fusion, progress=progress)


def _config(preset: str, config) -> Config:
    if config is None:
        return named_preset(preset)
    if not isinstance(config, Config):
        raise InputError(f"config is a {type(config).__name__}, expected pagas_cl.Config (start from pagas_cl.preset({preset!r}))")
    return config


def _checked_depth(depth, view: View) -> np.ndarray:
    depth = np.asarray(depth)
    size = view.camera.height, view.camera.width
    if depth.shape != size:
        raise InputError(f"depth map of view {view.name!r} has shape {depth.shape}, its photo {size}; resize it with "
                         "pagas_cl.scene.depthmap.resize_depth")
    if not (np.isfinite(depth) & (depth > 0)).any():
        raise InputError(f"depth map of view {view.name!r} has no valid pixel (all are zero, negative or not finite); expected "
                         "z-depths in scene units")
    return depth


def _asked(views, depths, names) -> list[int]:
    if len(depths) != len(views):
        raise InputError(f"{len(depths)} depth maps were given for {len(views)} views, expected one each (None where there is none)")
    have = [k for k, depth in enumerate(depths) if depth is not None and np.any(np.asarray(depth) > 0)]
    if names is None:
        if not have:
            raise InputError("no view has a depth map with a valid pixel: nothing to refine")
        return have
    known = {label: k for k, view in enumerate(views) for label in (view.name, view.stem)}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"no view is called {unknown[0]!r}; known are {', '.join(sorted({v.name for v in views})[:10])}")
    return [k for k in dict.fromkeys(known[name] for name in names)]


def _contexts(choice, number: int):
    """Context views, one more usable view as a witness where there is one, and the reason where there is none."""
    spare = choice.indices[number:]
    return choice.indices[:number], spare[0] if spare else None, choice.reason


def _harm(refined, witness) -> str:
    """Why a refinement is not to be trusted as a whole; empty where it is."""
    before, after = refined.witness or refined.cost
    judge = f"the photo of {witness.name}, which took no part," if refined.witness else "the context photos"
    if np.isfinite(after) and np.isfinite(before) and after > before:
        return f"{judge} matches worse through the refined depth (1 - correlation {before:.4f} before, {after:.4f} after)"
    return ""


def _steps_of(progress, target: View):
    return (lambda done, total: progress(f"refine {target.name}", done, total)) if progress else None
