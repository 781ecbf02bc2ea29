"""Depth maps to a mesh: TSDF fusion in a frame of its own.

The grid works relative to the middle of the depths and in units of their median, both taken out in float64, so that
coordinates of 5e6 or units of 1e-6 cost nothing. Voxel, truncation and range come from the depths.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import clean_depth, load_depth
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View
from pagas_cl.surface.convention import grid_shift
from pagas_cl.surface.grid import Grid, block_resolution
from pagas_cl.surface.memory import available_mb
from pagas_cl.surface.pieces import in_order, without_small_pieces

log = logging.getLogger("pagas_cl")

_VOXEL_BYTES = 20 * 1.1 + 16  # tsdf, weight, colour, with the grid's spare room; and what extracting the mesh adds
_VERTEX_BYTES = 80            # a vertex and its two triangles as extracted (measured)
_AFTER_BYTES = 300            # the same while it is cleaned and ordered, the grid gone (measured)
_VERTICES = 0.7               # vertices in a block, as a share of the voxels in one of its faces (measured)
_FAR = 100.0                  # pixels wider than this many voxels make flecks, not a surface
_WEIGHT_STEPS = 3             # Open3D integrates with weight 1; weights are made by integrating up to 3 times


@dataclass(frozen=True, eq=False)
class FusionPlan:
    """What a fusion will do, known before it starts.

    Attributes
    ----------
    voxel : float
        Scene units.
    truncation : float
        Scene units.
    depth_range : (float, float)
        Of all valid depths, scene units.
    blocks : list of ndarray of shape (N, 3), int32
        What each view touches; none for a view without depth.
    block_count : int
        Different blocks of all views together.
    memory_mb : float
        Host memory at the peak, without the photos and depth maps.
    middle : ndarray of shape (3,), float64
        World origin of the grid's frame.
    grid_scale : float
        Scene units of one unit of the grid.
    """

    voxel: float
    truncation: float
    depth_range: tuple[float, float]
    blocks: list[np.ndarray]
    block_count: int
    memory_mb: float
    middle: np.ndarray
    grid_scale: float

    def __str__(self) -> str:
        return (f"fusion: voxel {self.voxel:.4g}, truncation {self.truncation:.4g}, depths {self.depth_range[0]:.4g} "
                f"to {self.depth_range[1]:.4g}, {self.block_count} blocks, {self.memory_mb:.0f} MB")


def fusion_plan(views, depths, settings: Fusion = Fusion()) -> FusionPlan:
    """Voxel, range and memory of fusing `depths`.

    Parameters
    ----------
    views : list of View or Camera
    depths : list of (ndarray of shape (H, W), Path, or None)
        z-depth, 0 = no surface; paths are read when they are needed.
    """
    o3d = need("open3d", "mesh", "fusing depth maps to a mesh")
    cameras = [view.camera if isinstance(view, View) else view for view in views]
    if len(cameras) != len(depths):
        raise InputError(f"there are {len(cameras)} views and {len(depths)} depth maps, expected one each")
    footprint, grid_scale, middle, low, high = _measured(cameras, depths)
    voxel = settings.voxel * footprint
    grid = Grid(voxel / grid_scale, settings.truncation, 1, 2 * high / grid_scale, False, o3d)
    far = _FAR * voxel
    blocks, keys = [], np.zeros(0, np.int64)
    for camera, depth in zip(cameras, depths):
        depth = _depth(camera, depth, far, grid_scale)
        wide = depth is not None and depth.max() * grid_scale / camera.fx > 2 * voxel
        blocks.append(np.zeros((0, 3), np.int32) if depth is None
                      else grid.touched(depth, _intrinsics(camera), _pose(camera, middle, grid_scale),
                                        every=bool(wide)))
        keys = np.union1d(keys, _keys(blocks[-1]))
    count = len(keys)
    edge = block_resolution(settings.truncation)
    vertices = count * edge**2 * _VERTICES
    memory = max(count * edge**3 * _VOXEL_BYTES + vertices * _VERTEX_BYTES, vertices * _AFTER_BYTES) / 1e6
    return FusionPlan(voxel, settings.truncation * voxel, (low, high), blocks, count, memory, middle, grid_scale)


def fuse(views: list[View], depths, settings: Fusion = Fusion(), weights=None, progress=None, *,
         plan: FusionPlan | None = None, memory_mb: float | None = None) -> Surface:
    """Fuse depth maps to a mesh with colours and normals.

    Parameters
    ----------
    views : list of View
    depths : list of (ndarray of shape (H, W), Path, or None)
        z-depth in scene units, 0 = no surface. NaN is taken as 0: Open3D would invent surface there.
    settings : config.Fusion
    weights : list of (ndarray of shape (H, W) from 0 to 1, or None), optional
        How far each depth counts, rounded up to thirds; 0 leaves a pixel out. Open3D's own integration has no weights:
        a depth of weight 2/3 is integrated twice, so that `min_views` then counts thirds.
    progress : callable(stage, done, total), optional
    plan : FusionPlan, optional
        From `fusion_plan`, so that it is not made twice.
    memory_mb : float, optional
        Most host memory; what the machine has free where it is left out.

    Raises
    ------
    InputError
        No valid depth, an empty mesh, or more memory than allowed (before the work starts).
    """
    plan = plan or fusion_plan(views, depths, settings)
    log.info("%s", plan)
    _check_memory(plan, settings, memory_mb)
    grid = Grid(plan.voxel / plan.grid_scale, settings.truncation, plan.block_count,
                2 * plan.depth_range[1] / plan.grid_scale,
                True, need("open3d", "mesh", "fusing depth maps to a mesh"))
    for i, view in enumerate(views):
        _integrate(grid, plan, i, view, depths[i], None if weights is None else weights[i])
        if progress:
            progress("fuse", i + 1, len(views))
    tell = (lambda done: progress("extract the mesh", done, 2)) if progress else (lambda done: None)
    tell(0)
    seen = grid.seen()
    log.info("fusion: voxels seen by 1, 2, 3, more views: %s", ", ".join(map(str, seen)))
    extracted = grid.extract(settings.min_views - 0.5)
    del grid  # cleaning the mesh takes memory of its own
    tell(1)
    surface = _mesh(extracted, plan, settings, seen)
    tell(2)
    return surface


def _integrate(grid: Grid, plan: FusionPlan, index: int, view: View, depth, weight) -> None:
    depth = _depth(view.camera, depth, _FAR * plan.voxel, plan.grid_scale)
    if depth is None:
        return
    colour = view.load_image().astype(np.float32) / 255
    for share in _shares(depth, weight, view.name):
        grid.integrate(plan.blocks[index], share, colour, _intrinsics(view.camera),
                       _pose(view.camera, plan.middle, plan.grid_scale))


def _mesh(extracted, plan: FusionPlan, settings: Fusion, seen: np.ndarray) -> Surface:
    vertices, faces, normals, colours = extracted
    if len(faces) == 0:
        raise InputError(f"fused mesh is empty: depths {plan.depth_range[0]:.4g} to {plan.depth_range[1]:.4g}, voxel "
                         f"{plan.voxel:.4g}, truncation {plan.truncation:.4g}, fusion.min_views {settings.min_views}; "
                         f"voxels seen by 1, 2, 3, more views: {', '.join(map(str, seen))}; lower fusion.min_views, or "
                         f"change fusion.voxel (it is {settings.voxel:g})")
    keep, faces, dropped = without_small_pieces(faces, len(vertices), settings.min_component)
    if dropped:
        log.info("fusion: %d pieces with fewer than %g of the largest one's triangles are dropped", dropped,
                 settings.min_component)
    first, faces = in_order(vertices[keep], normals[keep], faces)
    keep = keep[first]
    length = np.linalg.norm(normals[keep], axis=1, keepdims=True)
    return Surface(vertices[keep].astype(np.float64) * plan.grid_scale + plan.middle, faces,
                   normals[keep] / np.where(length > 0, length, 1),
                   None if colours is None else np.clip(colours[keep], 0, 1))


def _measured(cameras: list[Camera], depths) -> tuple[float, float, np.ndarray, float, float]:
    """Median footprint, median depth, middle of the points, least and largest depth, from up to 4000 pixels a view."""
    footprints, all_depths, points = [], [], []
    for camera, depth in zip(cameras, depths):
        depth = _whole(camera, depth)
        if depth is None:
            continue
        step = max(1, int(np.sqrt(depth.size / 4000)))
        rows, columns = np.nonzero(depth[::step, ::step] > 0)
        if len(rows) == 0:
            rows, columns = np.nonzero(depth > 0)
            step = 1
        if len(rows) == 0:
            continue
        rows, columns = rows * step, columns * step
        z = depth[rows, columns].astype(np.float64)
        rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy,
                         np.ones(len(z))], -1)
        points.append(np.median(rays * z[:, None], axis=0) @ camera.world_to_camera[:3, :3] + camera.center)
        footprints.append(z / np.sqrt(camera.fx * camera.fy))
        all_depths.append((z, depth[depth > 0].min(), depth.max()))
    if not points:
        raise InputError(f"none of the {len(cameras)} depth maps has a valid depth (finite and above 0): nothing to "
                         "fuse")
    grid_scale = float(np.median(np.concatenate([z for z, _, _ in all_depths])))
    return (float(np.median(np.concatenate(footprints))), grid_scale, np.median(points, axis=0),
            float(min(low for _, low, _ in all_depths)), float(max(high for _, _, high in all_depths)))


def _whole(camera: Camera, depth) -> np.ndarray | None:
    """The depth map at the camera's size, clean, scene units."""
    if depth is None:
        return None
    if isinstance(depth, (str, Path)):
        return load_depth(depth, (camera.width, camera.height))
    depth = clean_depth(depth, f"depth map of {camera.name!r}")
    if depth.shape != (camera.height, camera.width):
        raise InputError(f"depth map of {camera.name!r} is {depth.shape[1]} x {depth.shape[0]}, its camera says "
                         f"{camera.width} x {camera.height}: resize_depth(depth, width, height)")
    return depth


def _depth(camera: Camera, depth, far: float, grid_scale: float) -> np.ndarray | None:
    """The same in the grid's unit, without pixels so far away that they are wider than `far`; None if none is left."""
    depth = _whole(camera, depth)
    if depth is None:
        return None
    depth = np.where(depth < far * min(camera.fx, camera.fy), depth * np.float32(1 / grid_scale), np.float32(0))
    return depth if (depth > 0).any() else None


def _intrinsics(camera: Camera) -> np.ndarray:
    K = camera.K
    K[:2, 2] += grid_shift()
    return K


def _pose(camera: Camera, middle: np.ndarray, grid_scale: float) -> np.ndarray:
    """World-to-camera for the grid's frame; places are subtracted before the product, to keep their digits."""
    pose = np.eye(4)
    pose[:3, :3] = camera.world_to_camera[:3, :3]
    pose[:3, 3] = pose[:3, :3] @ ((middle - camera.center) / grid_scale)
    return pose


def _keys(blocks: np.ndarray) -> np.ndarray:
    part = blocks.astype(np.int64) + (1 << 20)
    return (part[:, 0] << 42) | (part[:, 1] << 21) | part[:, 2]


def _shares(depth: np.ndarray, weight, name: str):
    """The depth map once, or up to three times with fewer and fewer pixels."""
    if weight is None:
        yield depth
        return
    weight = np.asarray(weight)
    if weight.shape != depth.shape:
        raise InputError(f"weights of {name!r} have shape {weight.shape}, expected {depth.shape}")
    for step in range(_WEIGHT_STEPS):
        share = np.where(weight > step / _WEIGHT_STEPS, depth, np.float32(0))
        if (share > 0).any():
            yield share


def _check_memory(plan: FusionPlan, settings: Fusion, memory_mb: float | None) -> None:
    allowed = available_mb() if memory_mb is None else memory_mb
    if plan.memory_mb > allowed:
        fits = settings.voxel * np.sqrt(plan.memory_mb / allowed) * 1.05
        raise InputError(f"fusion needs {plan.memory_mb:.0f} MB and {allowed:.0f} MB are free: set fusion.voxel to "
                         f"{fits:.2g} (it is {settings.voxel:g}), or give the machine more memory")
