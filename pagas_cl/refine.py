"""The method on one page (arXiv 2604.22129): photos, cameras and a coarse surface in, a finer surface out."""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.config.presets import settings_of
from pagas_cl.errors import InputError, check_kind, short
from pagas_cl.jobs import refine_all
from pagas_cl.jobs.fusing import fuse_results
from pagas_cl.jobs.place import Place
from pagas_cl.jobs.work_folder import kept_input, one_run, size_folder
from pagas_cl.method.cameras import refine as camera_refinement
from pagas_cl.method.cameras.effect import resolve_cameras
from pagas_cl.method.cameras.refine import CameraRefinement
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.keep_mesh import KeptMesh, kept_mesh
from pagas_cl.method.surface.mesh_options import NO_MESH, MeshOptions
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.view.coarse_to_fine import through_sizes
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.method.view.rounds import later_rounds
from pagas_cl.progress import NONE, Progress, Reporter, progress_of, stage
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Devices, one_of
from pagas_cl.scene.check.cameras import check_seen
from pagas_cl.scene.inputs import Cameras, Depth, Images, as_views, depth_array, depth_maps, requested_views
from pagas_cl.scene.mesh import Mesh, Surface
from pagas_cl.scene.meshes.kinds import from_surface, to_surface
from pagas_cl.scene.view import View, checked_views, joined


@dataclass(frozen=True, eq=False)
class Refined:
    """What a run gives: the views with the cameras that depth maps and mesh belong to, results as of refine_views, the
    mesh (of the kind that came in), what is known of the cameras, where they were refined before the views, and
    `mesh_limit`: in a sentence, why the mesh is coarser than its depth maps would allow, or unchanged; else empty."""

    views: list[View]
    results: list[DepthResult]
    mesh: Mesh | None
    cameras: CameraRefinement | None
    mesh_limit: str = ""


def refine_mesh(mesh: Mesh, cams: Cameras, images: Images, *, masks: Images | None = None, preset: str | None = None,
                config: Config | None = None, device: Devices | None = None, progress: Reporter = None,
                output: str = "mesh", subdivide: float | None = None, tolerance: float | None = None,
                triangles: int | None = None, memory: float | None = None, color: bool = False,
                executor: Executor | str | None = None, folder: str | Path | None = None) -> Mesh:
    """Refine a mesh with calibrated photos.

    mesh -> cameras, where they are off -> depth of every view -> refine each view by itself -> all vertices of the mesh
    onto what views agree on; or keep what other views confirm -> TSDF -> mesh (method sections 7, 9 and 10).

    Parameters
    ----------
    mesh : Open3D TriangleMesh (legacy or tensor), pymeshlab.Mesh, (vertices, faces), Surface, or the path of a file
    cams : list of Camera or Open3D PinholeCameraParameters, PinholeCameraTrajectory, or pycolmap Reconstruction
        Of a Reconstruction the images that have a pose, in the order of their names.
    images : list of arrays (H, W, 3) (uint8, uint16, or floating point from 0 to 1), Pillow images or paths, one a
        camera and in the order of the cameras; a dict of such by camera name; or a folder with files of these names
    masks : list of arrays (H, W) bool, Pillow images or paths, a dict or a folder as for images, optional
        True = used, of the target and of the context views; what is masked out of a view keeps its depth.
    preset : str, optional
        Name of the settings: "fast", "balanced" (where neither is given), "accurate" or "paper".
    config : Config, optional
        All settings, in place of `preset`: `pagas_cl.preset("fast").with_settings(...)`.
    device : str, list of str, or Device, optional
        Part of the name of an OpenCL device; a GPU before a CPU by default. "all", or a list of names: one process on
        each of these devices of this machine, for which a script needs `if __name__ == "__main__":` around what it
        does. `Device.of(queue)`: the caller's own pyopencl context and queue.
    progress : True, a function (stage, done, total), or a Progress, optional
        True: bars with the time left, in a terminal or a notebook. `done` has fractions within a view.
    output : str
        "mesh": the given mesh with as many triangles as the detail that photos show needs; what no photo sees stays,
        and so do texture coordinates and attributes.
        "tsdf": a new mesh, fused from the refined depth maps, of what photos see: where the given one has another
        topology than the truth. "displace": as "mesh" with the given triangles.
    subdivide : float, optional
        First split edges longer than this many pixel footprints; with "mesh" (1.5 where it is left out) only those that
        depth maps lie off, see `tolerance`.
    tolerance : float, optional
        With "mesh": how far off, in pixel footprints, triangles may be that are not split, or that several become
        (root mean square, method section 10.4). Left out: 0.025, more where depth maps are not that sure.
    triangles : int, optional
        With "mesh", in place of `tolerance`: how many triangles there are to be, within 2 %; those that matter least
        go first, also where no photo sees them. A warning says where it cannot be.
    memory : float, optional
        Most host memory for the mesh, MB (1e6 bytes): with "mesh" 450 bytes a triangle, with "tsdf" for the grid. Left
        out: half of what is free, with "tsdf" all of it. A warning says where a mesh is coarser for want of it.
    color : bool
        Vertices get the mean colour of the photos that see them (a fused mesh has such anyhow); not of a pair.
    executor, folder
        As in refine_views.

    Returns
    -------
    A mesh of the kind that came in (a path gives a Surface); with "tsdf", new colours and normals, else
    the vertices' "deviation" (scene units) and "views" where the kind has attributes.

    Raises
    ------
    InputError, DeviceError, MissingExtraError
    """
    if not isinstance(output, str) or output not in ("mesh", "tsdf", "displace"):
        raise InputError(f"output is {short(output)}, expected 'mesh', 'tsdf' or 'displace'")
    making = MeshOptions(output, subdivide, tolerance, triangles, memory, color)
    making.check()
    if color and isinstance(mesh, (tuple, list)):
        raise InputError("color is True and the mesh a pair (vertices, faces), which has no place for colours: give a "
                         "pagas_cl Surface, an Open3D or pymeshlab mesh, or a path")
    given = to_surface(mesh) if isinstance(mesh, (str, Path)) else mesh
    place = Place(device, executor, folder)
    return refine_scene(as_views(cams, images, masks), given, None, settings_of(preset, config),
                        making=making, place=place, progress=progress).mesh


def refine_scene(views: Sequence[View], mesh: Mesh | None, depths: Sequence[Depth | None] | None, config: Config, *,
                 names: Collection[str] | None = None, making: MeshOptions = NO_MESH, place: Place = Place(),
                 progress: Reporter = None, on_view: Callable[[View, Depth, DepthResult], Any] | None = None,
                 choose: Callable[[list[View], Sequence[Any], Config], Config] | None = None) -> Refined:
    """The whole run, from a mesh or from depth maps: what refine_mesh and the command line do.

    `choose(views, depths, config)` gives the settings to go on with, once cameras and depth maps are there. The other
    parameters are as in refine_mesh and refine_views.
    """
    shown = progress_of(progress)
    with one_run(place.folder):
        views, cameras = list(views), None
        with place.at_work() as (working, photos):
            if mesh is not None:
                surface = to_surface(mesh)
                views, config, cameras = resolve_cameras(views, surface, config, place.device, shown, photos,
                                                         working.blocks)
                depths = initial_depths(surface, views, shown, _kept_in(place.folder), place.device)
            elif depths is None:
                raise InputError("expected a mesh or depth maps to start from, got neither")
            if choose is not None:
                config = choose(views, depths, config)
            results = _refine_views(views, depths, names, config, working, photos, shown, on_view)
        made = _made(views, results, mesh, config, making, place, shown)
        return Refined(views, results, made.mesh, cameras, made.limit)


def _made(views: list[View], results: list[DepthResult], mesh: Mesh | None, config: Config, making: MeshOptions,
          place: Place, progress: Progress) -> KeptMesh:
    """The mesh that comes of refined depth maps, None where there is to be none."""
    if making.output is None:
        return KeptMesh(None)
    if making.output == "tsdf":
        fused = fuse_results(views, results, config, progress, making, place)
        return KeptMesh(fused if mesh is None else from_surface(fused, like=mesh))
    return kept_mesh(mesh, views, results, config, making, place.device, progress)


def _kept_in(folder: str | Path | None) -> Callable[[np.ndarray], Any] | None:
    """What keeps a depth map in the work folder of a run."""
    return None if folder is None else partial(kept_input, Path(folder).resolve())


def refine_views(views: Sequence[View], depths: Sequence[Depth | None], *, names: Collection[str] | None = None,
                 config: Config | None = None, preset: str | None = None, device: Devices | None = None,
                 progress: Reporter = None, on_view: Callable[[View, Depth, DepthResult], Any] | None = None,
                 executor: Executor | str | None = None, folder: str | Path | None = None,
                 extras: bool = True) -> list[DepthResult]:
    """Refine the depth maps of many views, each by itself; where cameras are off, these first (effects.cameras): each
    result has the camera that its depth map belongs to. Then, where the effect `agreement` is on, in rounds in
    which depth maps of views that see the same surface are evidence for one another (method section 8.1).

    Parameters
    ----------
    views : list of View
    depths : list of arrays (H, W), one a view; None where a view has none
        Initial z-depth in scene units, 0 = no surface.
    names : collection of str, optional
        Views to refine, which have a depth map; all that have one by default. The others are context views still.
    on_view : callable of (view, initial depth, DepthResult), optional
        Called when a view is finished, in the last round; what it returns is dropped.
    executor : concurrent.futures.Executor, or the address of a Dask scheduler, optional
        Where the views are refined instead of in this process; see pagas_cl.jobs.
    folder : path, optional
        Keeps each finished view; a run with the same inputs and settings goes on from them. Results then read
        their arrays from there when these are used.
    extras : bool
        With `folder`: whether it keeps status, deviation and parallax too, 9 bytes a pixel.

    Returns
    -------
    list of DepthResult, in the order of the views that were requested, without those whose depth map has no valid
        pixel: the `name` of each says of which view it is

    Raises
    ------
    InputError, DeviceError
    """
    check_kind("on_view", on_view, (Callable, NoneType), "a function of (view, initial depth, DepthResult)")
    config, views = settings_of(preset, config), checked_views("views", views)
    with Place(device, executor, folder).at_work() as (place, photos):
        return _refine_views(views, depths, names, config, place, photos, progress_of(progress), on_view, extras)


def _refine_views(views: list[View], depths: Sequence[Depth | None], names: Collection[str] | None, config: Config,
                  place: Place, photos: PhotoStore | None, progress: Progress, on_view: Callable[..., Any] | None,
                  extras: bool = True) -> list[DepthResult]:
    """refine_views; `photos` as of Place.at_work."""
    depths = depth_maps(views, depths)
    chosen = requested_views(views, depths, names)
    views, config, cameras = resolve_cameras(views, depths, config, place.device, progress, photos, place.blocks)
    depths = depths if cameras is None else cameras.scaled(depths)
    run = partial(refine_all, refine_one, device=place.device, executor=place.executor, progress=progress,
                  photos=photos, later=later_rounds(config, len(chosen)))

    def refine_small(small: list[View], start: list[Any], config: Config, number: int,
                     scale: float) -> list[DepthResult]:
        return run(small, start, chosen, config, folder=size_folder(place.folder, number),
                   at=f", pass {number + 1} at {scale:g} of the size")

    starts = through_sizes(refine_small, views, depths, chosen, config, cache(lambda: photos or place.photos_here()),
                           _kept_in(place.folder), photos, progress)
    given = {id(view): depth for view, depth in zip(views, depths)}
    results = run(views, starts.depths, chosen, starts.config, folder=place.folder, extras=extras,
                  on_view=on_view and (lambda view, _, result: on_view(view, depth_array(given[id(view)]),
                                                               starts.noted(result))))
    starts.log_moved(views, results)
    for result in results:
        starts.noted(result)
    if cameras is not None:
        for place_of_view, result in joined(views, results):
            result.report["camera"] = {"moved": float(cameras.moved[place_of_view]), "accepted": cameras.accepted}
    return results


def refine_cameras(views: Sequence[View], depths_or_mesh: Sequence[Depth | None] | Mesh, *,
                   device: Devices | None = None, executor: Executor | str | None = None,
                   folder: str | Path | None = None, **options: Any) -> CameraRefinement:
    """Refine the cameras of `views`, so that their photos agree through the surface: as
    pagas_cl.method.cameras.refine.refine_cameras, whose further parameters (unknowns, lenses, gauge, measured, preset,
    config, progress) are `options`, with blocks of views added up where refine_views works. The same bytes."""
    with Place(device, executor, folder).blocks() as make_blocks:
        return camera_refinement.refine_cameras(views, depths_or_mesh, device=one_of(device), make_blocks=make_blocks,
                                                **options)


def initial_depths(surface: Surface, views: Sequence[View], progress: Progress = NONE,
                   keep: Callable[[np.ndarray], Any] | None = None, device: Devices | None = None) -> list[Any]:
    """Depth of every view from the surface, float32 of shape (H, W), 0 = no surface: drawn on `device` (as in
    refine_mesh), by Open3D's ray casting where there is none.

    `keep` replaces each by what stands for it, such as the place where it put it.
    """
    cameras, depths = [view.camera for view in views], []
    check_seen(surface, cameras)
    with stage(progress, "render the mesh", len(cameras)) as rendering:
        for depth in each_depth(surface, cameras, comparison_device(device)):
            depths.append(keep(depth) if keep else depth)
            rendering.advance(len(depths))
    return depths
