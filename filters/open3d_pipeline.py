"""A step for Open3D's RGB-D pipelines: refine the frames, then integrate them as before.

    frames = refine_rgbd(frames, intrinsic, extrinsics)        # before the loop of the RGBD-integration tutorial
    mesh = refine_and_integrate(frames, intrinsic, extrinsics) # or all of it in one call

Half pixels: Open3D's legacy cameras (PinholeCameraIntrinsic) and volumes count pixel centres at whole numbers, its
VoxelBlockGrid at +0.5. Intrinsics are read with `pixel_center` (0, as the legacy ones have it); what goes into a
VoxelBlockGrid here is shifted as a measurement of the installed Open3D says (surface.grid).
"""

from dataclasses import replace

import numpy as np

from pagas_cl.config import Config, Fusion
from pagas_cl.config.presets import settings_of
from pagas_cl.errors import InputError, log, need
from pagas_cl.filters.open3d_frames import Frame, above_zero, as_numpy, give_back, read_frames
from pagas_cl.jobs.fusing import fuse_results
from pagas_cl.jobs.place import Place
from pagas_cl.method.surface.agree import disagreement
from pagas_cl.method.surface.fuse import fusion_plan
from pagas_cl.method.surface.grid import grid_shift
from pagas_cl.method.surface.on_vertices import vertex_confidence
from pagas_cl.progress import progress_of
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.meshes.kinds import from_surface


def refine_rgbd(frames, intrinsics, extrinsics=None, *, depth_scale: float | None = None,
                depth_trunc: float | None = None, pixel_center: float = 0.0, preset: str | None = None,
                config: Config | None = None, device=None, progress=None, agree_within: float | None = None) -> list:
    """Refine the depth of RGB-D frames with each other's colours.

    Parameters
    ----------
    frames : list of RGBDImage (legacy or tensor), or of pairs (color, depth)
        Parts of pairs: Image (legacy or tensor), images of Pillow, arrays, or paths.
    intrinsics : PinholeCameraIntrinsic, (3, 3) array or tensor, a list of them, a PinholeCameraTrajectory, or a list of
        PinholeCameraParameters
    extrinsics : list of (4, 4) arrays or tensors, optional
        World-to-camera, as Open3D's `integrate` takes them; left out with the last two.
    depth_scale : float, optional
        What divides depth numbers, in Open3D's meaning; 1000 for whole numbers and 1 for floating point where it is
        left out. A legacy RGBDImage has been divided already.
    depth_trunc : float, optional
        Depths that reach it (scene units) are dropped, in Open3D's meaning; none are where it is left out.
    pixel_center : float
        Where the intrinsics put the centre of the top-left pixel: 0 (Open3D's legacy cameras) or 0.5 (COLMAP).
    preset, config, device, progress
        As in refine_mesh.
    agree_within : float, optional
        Take a refined depth only where the refined frames agree on it to this share of the depth, averaged over 9 x 9
        pixels (0.01: a centimetre at a metre), and keep the sensor's at all others. For sensors that are surer than the
        photos: at short baselines a pixel of parallax can be many times a sensor's error.

    Returns
    -------
    list of the same form, in the same order
        Depth is float32 in the numbers that came in (times depth_scale); valid where it was. Colours of tensors are
        float32 from 0 to 1, which VoxelBlockGrid wants with floating point depth.
    """
    config = settings_of(preset, config)
    read = read_frames(frames, intrinsics, extrinsics, depth_scale=depth_scale, depth_trunc=depth_trunc,
                       pixel_center=pixel_center)
    depths = [result.depth for result in _refined(read, config, device, progress)]
    if agree_within is not None:
        depths = _agreed(read, depths, agree_within)
    return [give_back(frame, depth) for frame, depth in zip(read, depths)]


def refine_and_integrate(frames, intrinsics, extrinsics=None, *, voxel_size: float | None = None,
                         depth_scale: float | None = None, depth_trunc: float | None = None, pixel_center: float = 0.0,
                         preset: str | None = None, config: Config | None = None, device=None, progress=None):
    """Refine the frames, integrate them into a VoxelBlockGrid and extract the mesh.

    `voxel_size`: scene units, in Open3D's meaning; the setting fusion.voxel (pixel footprints) where it is left out.
    The others as in refine_rgbd. Returns an open3d.t.geometry.TriangleMesh with colours, normals, and "quality": the
    mean confidence (0 to 1) of the views that see a vertex.
    """
    config = settings_of(preset, config)
    read = read_frames(frames, intrinsics, extrinsics, depth_scale=depth_scale, depth_trunc=depth_trunc,
                       pixel_center=pixel_center)
    if voxel_size is not None:
        if not above_zero(voxel_size):
            raise InputError(f"voxel_size is {voxel_size!r}, expected scene units above 0")
        coarse = 64.0  # only the plan's footprint is used: let it touch few blocks
        plan = fusion_plan([frame.view for frame in read], [frame.depth for frame in read], Fusion(voxel=coarse))
        try:
            config = config.with_settings(fusion__voxel=float(voxel_size * coarse / plan.voxel))
        except InputError as error:
            raise InputError(f"voxel_size is {voxel_size:g} scene units, in pixel footprints: {error}; is it in the "
                             "unit of the cameras?") from error
    results = _refined(read, config, device, progress)
    surface = fuse_results([frame.view for frame in read], results, config, progress_of(progress), place=Place(device))
    quality = vertex_confidence(surface.vertices, results)
    o3d = need("open3d", "mesh", "making an Open3D mesh")
    return from_surface(replace(surface, quality=quality), like=o3d.t.geometry.TriangleMesh())


def grid_intrinsic(intrinsic, *, pixel_center: float = 0.0):
    """K (3, 3), an open3d.core.Tensor of float64, as this Open3D's VoxelBlockGrid wants it, for a loop of your own.

    Passing a legacy intrinsic to a VoxelBlockGrid unchanged puts the surface half a pixel off.
    """
    o3d = need("open3d", "mesh", "a VoxelBlockGrid")
    K = as_numpy(getattr(intrinsic, "intrinsic_matrix", intrinsic))
    K = Camera.from_opencv_w2c(K, np.eye(4), 1, 1, pixel_center=pixel_center, name="of the grid").K
    K[:2, 2] += grid_shift()
    return o3d.core.Tensor(K)


def _refined(read: list[Frame], config: Config, device, progress) -> list:
    """One DepthResult a frame; a frame without any depth is given back unchanged."""
    views, depths = [frame.view for frame in read], [frame.depth if (frame.depth > 0).any() else None for frame in read]
    if not any(depth is not None for depth in depths):
        raise InputError(f"none of the {len(read)} frames has a valid depth: are depth_scale and depth_trunc right?")
    if config.effects.cameras == "auto":      # the pipeline goes on with cameras of its own: they stay
        config = config.with_settings(effects__cameras="set")
    refined, results = iter(refine_views(views, depths, config=config, device=device, progress=progress)), []
    for frame, depth in zip(read, depths):
        result = None if depth is None else next(refined)
        reason = "the frame has no depth" if result is None else result.report.get("failed")
        if reason:  # a pipeline expects every frame back: one that could not be refined stays unchanged
            result = DepthResult.unrefined(frame.view.camera, frame.depth, reason, name=frame.view.name)
        results.append(result)
    return results


def _agreed(read: list[Frame], depths: list[np.ndarray], share: float) -> list[np.ndarray]:
    """Refined depths where the refined frames agree on them, those that came in at all other pixels."""
    if not above_zero(share):
        raise InputError(f"agree_within is {share!r}, expected a share of the depth above 0, such as 0.01")
    cameras, chosen, taken = [frame.view.camera for frame in read], [], 0
    for i, frame in enumerate(read):
        others = [j for j in range(len(read)) if j != i]
        error = disagreement(cameras[i], depths[i], [cameras[j] for j in others], [depths[j] for j in others])
        with np.errstate(invalid="ignore"):
            take = error <= share
        taken += np.count_nonzero(take & (frame.depth > 0))
        chosen.append(np.where(take, depths[i], frame.depth))
    total = sum(np.count_nonzero(frame.depth) for frame in read)
    log.info("frames agree within %g of the depth on %.0f %% of the refined depths; the rest stays unchanged", share,
             100 * taken / max(1, total))
    return chosen
