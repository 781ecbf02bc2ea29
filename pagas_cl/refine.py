"""The method on one page (arXiv 2604.22129): photos, cameras and a coarse surface in, a finer surface out."""

from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.before_steps import BeforeSteps
from pagas_cl.cameras.effect import settle_cameras
from pagas_cl.config import Config
from pagas_cl.effects import decide_consistency
from pagas_cl.errors import InputError, log
from pagas_cl.jobs import refine_all
from pagas_cl.keep_mesh import FLAT, check_flat, check_subdivide, kept_mesh, polished
from pagas_cl.one_view import refine_one
from pagas_cl.presets import settings_of
from pagas_cl.progress import Progress, ViewProgress
from pagas_cl.result import DepthResult, OnDisk, joined
from pagas_cl.rounds import later_rounds
from pagas_cl.runtime.device import Devices
from pagas_cl.scene.check import check_seen
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.scene.inputs import Cameras, Depth, Images, as_views, asked_views, depth_array, depth_maps
from pagas_cl.scene.mesh import Mesh, Surface, from_surface, to_surface
from pagas_cl.scene.reasons import warn_of_nothing
from pagas_cl.scene.view import View
from pagas_cl.splat import PhotoStore, photos_here
from pagas_cl.surface import blocks
from pagas_cl.surface.agree import comparison_device, confirmed
from pagas_cl.surface.fuse import weights_of
from pagas_cl.surface.raster import each_depth


def refine_mesh(mesh: Mesh, cams: Cameras, images: Images, *, masks: Images | None = None, preset: str | None = None,
                config: Config | None = None, device: Devices | None = None, progress: Progress | None = None,
                output: str = "mesh", subdivide: float | None = None, flat: float = FLAT,
                executor: Executor | str | None = None, folder: str | Path | None = None) -> Mesh:
    """Refine a mesh with calibrated photos.

    mesh -> cameras, where they are off -> depth of every view -> refine each view by itself -> all vertices of the mesh
    onto what views agree on; or keep what other views confirm -> TSDF -> mesh (method sections 7, 9 and 10).

    Parameters
    ----------
    mesh : Open3D TriangleMesh (legacy or tensor), pymeshlab.Mesh, (vertices, faces), Surface, or the path of a file
    cams : list of Camera, Open3D PinholeCameraTrajectory, or pycolmap Reconstruction
    images : list of arrays (H, W, 3) (uint8, or floating point from 0 to 1) or paths, one a camera, or a folder
    masks : list of arrays (H, W) bool or paths, optional
        True = used, of the target and of the context views; what is masked out of a view keeps its depth.
    preset : str, optional
        Name of the settings: "fast", "balanced" (where neither is given), "accurate" or "paper".
    config : Config, optional
        All settings, in place of `preset`: `pagas_cl.preset("fast").with_settings(...)`.
    device : str, optional
        Part of the name of an OpenCL device; a GPU before a CPU by default. "all", or a list of names: one process on
        each of these devices of this machine.
    progress : callable of (stage, done, total), optional
        `done` is a fraction within a view.
    output : str
        "mesh": the given mesh with as many triangles as the detail that photos show needs; what no photo sees stays,
        and so do texture coordinates and attributes; in 300 MB of host memory, or 14 bytes a pixel of all photos.
        "tsdf": a new mesh, fused from the refined depth maps, of what photos see: where the given one has another
        topology than the truth. "displace": as "mesh" with the given triangles; a path gives an Open3D mesh with its
        textures, that of a .ply a Surface.
    subdivide : float, optional
        First split edges longer than this many pixel footprints; with "mesh" (1.5 where it is left out) only those that
        depth maps lie off.
    flat : float
        With "mesh": edges are split that depth maps lie off by more than half of this many pixel footprints; splits
        are undone where the surface stays true to within it.
    executor, folder
        As in refine_views.

    Returns
    -------
    A mesh of the kind that came in (a path gives a Surface, see `output`); with "tsdf", new colours and normals, else
    the vertices' "deviation" (scene units) and "views" where the kind has attributes.

    Raises
    ------
    InputError, DeviceError, MissingExtraError
    """
    if output not in ("mesh", "tsdf", "displace"):
        raise InputError(f"output is {output!r}, expected 'mesh', 'tsdf' or 'displace'")
    check_subdivide(subdivide)
    check_flat(flat)
    config, views, surface = settings_of(preset, config), as_views(cams, images, masks), to_surface(mesh)
    photos = photos_here(device, executor, folder)
    views, config, _ = settle_cameras(views, surface, config, device, progress, photos, executor, folder)
    depths = initial_depths(surface, views, progress, device=device)
    results = refine_views(views, depths, config=config, device=device, progress=progress, executor=executor,
                           folder=folder, photos=photos)
    if output != "tsdf":
        given = surface if output == "mesh" and isinstance(mesh, (str, Path)) else mesh
        return kept_mesh(given, views, results, config, output, subdivide, flat, device, progress=progress)
    fused = fuse_results(views, results, config, progress, executor=executor, folder=folder, device=device)
    return from_surface(fused, like=mesh)


def refine_views(views: Sequence[View], depths: Sequence[Depth | None], *, names: Collection[str] | None = None,
                 config: Config | None = None, preset: str | None = None, device: Devices | None = None,
                 progress: Progress | None = None, on_view: Callable[[View, Depth, DepthResult], Any] | None = None,
                 executor: Executor | str | None = None, folder: str | Path | None = None,
                 extras: bool = True, photos: PhotoStore | None = None) -> list[DepthResult]:
    """Refine the depth maps of many views, each by itself; where cameras are off, these first (effects.cameras): each
    result has the camera that its depth map belongs to. Then, where the effect `agreement` is called for, in rounds in
    which depth maps of views that see the same surface are evidence for one another (method section 8.1).

    Parameters
    ----------
    views : list of View
    depths : list of arrays (H, W), one a view; None where a view has none
        Initial z-depth in scene units, 0 = no surface.
    names : collection of str, optional
        Views to refine; all that have a depth map by default. The others are context views still.
    on_view : callable of (view, initial depth, DepthResult), optional
        Called when a view is finished, in the last round (with `folder`: its batch of 64); what it returns is dropped.
    executor : concurrent.futures.Executor, or the address of a Dask scheduler, optional
        Where the views are refined instead of in this process; see pagas_cl.jobs.
    folder : path, optional
        Keeps each finished view; a run with the same inputs, settings and code goes on from them. Results then read
        their arrays from there when they are asked for.
    extras : bool
        With `folder`: whether it keeps status, deviation and parallax too, 9 bytes a pixel.
    photos : PhotoStore, optional
        Photos that are on the one device already; they are forgotten in the end.

    Returns
    -------
    list of DepthResult, in the order of the views that were asked for

    Raises
    ------
    InputError, DeviceError
    """
    config, depths = settings_of(preset, config), depth_maps(views, depths)
    asked = asked_views(views, depths, names)
    photos = photos_here(device, executor, folder, photos)
    views, config, cameras = settle_cameras(views, depths, config, device, progress, photos, executor, folder)
    depths, later = depths if cameras is None else cameras.scaled(depths), later_rounds(config, len(asked))
    if photos is None:
        return refine_all(refine_one, views, depths, asked, config, device=device, executor=executor, folder=folder,
                          extras=extras, progress=progress, on_view=on_view, later=later, before=BeforeSteps)
    opened, results, view_progress = photos.device, [], ViewProgress(progress, len(asked))
    arrays: list[Any] = [None if depth is None else depth_array(depth) for depth in depths]
    chooser = PartnerChooser([view.camera for view in views], arrays, config.context)
    partners = {index: chooser.choose(index) for index in asked}
    found = deque(BeforeSteps(views, partners[index], arrays[index], config, opened, photos) for index in asked)
    for done, index in enumerate(asked):
        view_progress.at(done)
        own = found.popleft()
        following = found[0].go_on if found and not photos.on_host else None
        results.append(refine_one(views, partners[index], arrays[index], config, opened, photos,
                                  progress=view_progress.inside(done), before=own, meanwhile=following))
        if cameras is not None:
            results[-1].report["camera"] = {"moved": float(cameras.moved[index]), "accepted": cameras.accepted}
        if on_view and not later:
            on_view(views[index], arrays[index], results[-1])
    view_progress.at(len(asked))
    for number, later_round in enumerate(later, start=1):
        view_progress, before = ViewProgress(progress, len(asked), f"agree, round {number}"), dict(zip(asked, results))
        for done, index in enumerate(asked):
            view_progress.at(done)
            given = [before[k] for k in partners[index].refined(before)]
            results[done] = later_round.work(views, partners[index], given, config, opened, photos,
                                             progress=view_progress.inside(done), reuse=True)
            if on_view and number == len(later):
                on_view(views[index], arrays[index], results[done])
        view_progress.at(len(asked))
        photos.forget(before.values())
    photos.clear()
    warn_of_nothing(views, depths, results)
    return results


def initial_depths(surface: Surface, views: Sequence[View], progress: Progress | None = None,
                   keep: Callable[[np.ndarray], Any] | None = None, device: Devices | None = None) -> list[Any]:
    """Depth of every view from the surface, float32 of shape (H, W), 0 = no surface: drawn on `device` (as in
    refine_mesh), by Open3D's ray casting where there is none.

    `keep` replaces each by what stands for it, such as the place where it put it.
    """
    cameras, depths = [view.camera for view in views], []
    check_seen(surface, cameras)
    for depth in each_depth(surface, cameras, comparison_device(device)):
        depths.append(keep(depth) if keep else depth)
        if progress:
            progress("render the mesh", len(depths), len(cameras))
    return depths


def fuse_results(views: Sequence[View], results: Sequence[DepthResult], config: Config,
                 progress: Progress | None = None, memory_mb: float | None = None,
                 tell: Callable[[str], Any] | None = None, *, executor: Executor | str | None = None,
                 folder: str | Path | None = None, device: Devices | None = None) -> Surface:
    """Keep what other views confirm, then TSDF: a Surface. In `memory_mb` of host memory, or what is free.

    Results find their views by name (see result.joined); views without one take no part.
    `tell(text)` is told whether other views were asked, and why. Where one grid does not fit, its boxes go to
    `executor`, if that is a concurrent.futures.Executor and photos and depth maps are files that it can read. Views are
    compared on `device` (as in refine_mesh), in NumPy where there is none.
    """
    device, pairs = comparison_device(device), sorted(joined(views, results), key=lambda pair: pair[0])
    used = [views[place] if result.camera is views[place].camera else replace(views[place], camera=result.camera)
            for place, result in pairs]      # a result's camera may have been refined with it
    results = [result for _, result in pairs]
    cameras = [view.camera for view in used]
    config, decision = decide_consistency(cameras, results, config, device)
    if decision is not None:
        log.info("%s", decision)
        if tell:
            tell(str(decision))
    on_disk = config.fusion.agree_views == 0  # read one at a time, then
    depths = [result.file if on_disk and isinstance(result, OnDisk) else result.depth for result in results]
    agreed = confirmed(cameras, depths, config.fusion, device=device)
    files = all(isinstance(source, Path) for source in (*agreed, *(view.image for view in used)))
    elsewhere = executor if files and hasattr(executor, "map") else None      # not where it is an address
    fused = blocks.fuse_within(used, agreed, config.fusion, memory_mb, progress=progress, executor=elsewhere,
                               folder=folder, weights=weights_of(results, config.fusion.least_weight))
    return polished(fused, results, config, device) if config.fusion.polish and device is not None else fused
