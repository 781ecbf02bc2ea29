"""Depth maps to a mesh: TSDF fusion in a frame of its own.

The grid works relative to the middle of the depths and in units of their median, both taken out in float64, so that
coordinates of 5e6 or units of 1e-6 cost nothing. Voxel, truncation and range come from the depths."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, log
from pagas_cl.method.surface.grid import Grid, Union, block_resolution, grid_shift
from pagas_cl.method.surface.weld import in_order, without_small_components
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.runtime.host import available_mb
from pagas_cl.scene.camera import Camera, rigid
from pagas_cl.scene.depthmap import clean_depth, load_depth
from pagas_cl.scene.images import Loads
from pagas_cl.scene.inputs import check_maps, check_one_each
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View

_VOXEL_BYTES = 20 * 1.1 + 16  # tsdf, weight, colour, with the grid's spare room; and what extracting the mesh adds
_VERTEX_BYTES = 80            # a vertex and its two triangles as extracted (measured)
_AFTER_BYTES = 300            # the same while it is cleaned and ordered, the grid gone (measured)
_SURFACE_BYTES = 72           # the same in the mesh that comes out
_VERTICES = 0.7               # vertices in a block, as a share of the voxels in one of its faces (measured)
_FAR = 100.0                  # pixels wider than this many voxels make flecks, not a surface
_WEIGHT_STEPS = 3             # Open3D integrates with weight 1; weights are made by integrating up to 3 times


@dataclass(frozen=True, eq=False)
class FusionPlan:
    """What a fusion will do, known before it starts."""

    settings: Fusion
    voxel: float                        # scene units
    depth_range: tuple[float, float]    # of all valid depths, scene units
    middle: np.ndarray                  # (3,) float64: world origin of the grid's frame
    grid_scale: float                   # scene units of one unit of the grid
    blocks: Sequence[np.ndarray]        # for each view those that it touches, (N, 3) int32; none without depth
    block_count: int = 0                # different blocks of all views together

    @property
    def truncation(self) -> float:
        """Scene units."""
        return self.settings.truncation * self.voxel

    @property
    def memory_mb(self) -> float:
        """Host memory at the peak, without the photos and depth maps."""
        return grid_mb(self.block_count, self.settings)

    @property
    def mesh_mb(self) -> float:
        """Host memory of the mesh that comes out."""
        return _vertices(self.block_count, self.settings) * _SURFACE_BYTES / 1e6

    def grid(self, blocks: int, colour: bool = True) -> Grid:
        return Grid(self.voxel / self.grid_scale, self.settings.truncation, blocks,
                    2 * self.depth_range[1] / self.grid_scale, colour)

    def __str__(self) -> str:
        return (f"fusion: voxel {self.voxel:.4g}, truncation {self.truncation:.4g}, depths {self.depth_range[0]:.4g} "
                f"to {self.depth_range[1]:.4g}, {self.block_count} blocks, {self.memory_mb:.0f} MB")

    def in_world(self, vertices, normals, colours):
        """What a grid gave in world coordinates (float64), with unit normals and colours from 0 to 1."""
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return (vertices.astype(np.float64) * self.grid_scale + self.middle,
                normals / np.where(length > 0, length, 1), np.clip(colours, 0, 1))

    def empty_mesh(self, seen: str = "") -> InputError:
        """The error to raise where no triangle came out; `seen` says how many views saw the voxels."""
        low, high = self.depth_range
        return InputError(f"fused mesh is empty: depths {low:.4g} to {high:.4g}, voxel {self.voxel:.4g}, truncation "
                          f"{self.truncation:.4g}, fusion.min_views {self.settings.min_views};{seen} lower "
                          f"fusion.min_views, or change fusion.voxel (it is {self.settings.voxel:g}); what masks leave "
                          "out is not fused")

    def log_dropped(self, components: int) -> None:
        if components:
            log.info("%d small fragments apart from the main surface are left out of the mesh (of fewer triangles than "
                     "%g of the largest part's; --set fusion.min_component=0 keeps them)", components,
                     self.settings.min_component)


def fusion_plan(views, depths, settings: Fusion = Fusion()) -> FusionPlan:
    """Voxel, range and memory of fusing `depths`; arguments as in `fuse`, cameras may stand for views."""
    return plan_with_blocks(views, depths, settings, [])[0]


def plan_with_blocks(views, depths, settings: Fusion, of_views,
                     progress: Progress = NONE) -> tuple[FusionPlan, np.ndarray]:
    """`fusion_plan`, and all different blocks: int32 of shape (N, 3). Those of each view are appended to `of_views`."""
    cameras = [view.camera if isinstance(view, View) else view for view in views]
    check_one_each(depths, len(cameras))
    footprint, grid_scale, middle, low, high = _measured(cameras, depths)
    plan = FusionPlan(settings, settings.voxel * footprint, (low, high), middle, grid_scale, of_views)
    grid, union = plan.grid(1, colour=False), Union()
    with stage(progress, "plan the mesh", len(cameras)) as planning:
        for camera, depth in zip(cameras, depths):
            depth, blocks = _in_grid(plan, camera, depth), np.zeros((0, 3), np.int32)
            if depth is not None:
                wide = bool(depth.max() * grid_scale / camera.fx > 2 * plan.voxel)
                blocks = grid.touched(depth, *_in_frame(plan, camera), every=wide)
            of_views.append(blocks)
            union.add(blocks)
            planning.advance(len(of_views))
    blocks = union.blocks()
    return replace(plan, block_count=len(blocks)), blocks


def grid_mb(blocks: int, settings: Fusion) -> float:
    """Host memory of fusing so many blocks in one grid, MB."""
    vertices = _vertices(blocks, settings)
    grid = blocks * block_resolution(settings.truncation)**3 * _VOXEL_BYTES + vertices * _VERTEX_BYTES
    return max(grid, vertices * _AFTER_BYTES) / 1e6


def _vertices(blocks: int, settings: Fusion) -> float:
    return blocks * block_resolution(settings.truncation)**2 * _VERTICES


def fuse(views: list[View], depths, settings: Fusion = Fusion(), weights=None, progress: Progress = NONE, *,
         plan: FusionPlan | None = None, memory_mb: float | None = None) -> Surface:
    """Fuse depth maps to a mesh with colours and normals.

    `depths`: arrays (H, W), paths, or None: z-depth in scene units, 0 = no surface. NaN is taken as 0: Open3D would
    invent surface there. `weights`: arrays (H, W) from 0 to 1, or None: how far each depth counts, rounded up to
    thirds; 0 leaves a pixel out. Open3D's own integration has no weights: a depth of weight 2/3 is integrated twice, so
    that `min_views` then counts thirds. `plan`: from `fusion_plan` with these settings, so that it is not made twice.
    `memory_mb`: most host memory; what is free by default. InputError where it is too little (before the work), where
    no depth is valid, and where the mesh is empty."""
    plan = plan or fusion_plan(views, depths, settings)
    log.debug("%s", plan)
    allowed = available_mb() if memory_mb is None else memory_mb
    if plan.memory_mb > allowed:
        fits = settings.voxel * np.sqrt(plan.memory_mb / allowed) * 1.05
        raise InputError(f"fusion needs {plan.memory_mb:.0f} MB and {allowed:.0f} MB are free: set fusion.voxel to "
                         f"{fits:.2g} (it is {settings.voxel:g}), or give the machine more memory")
    grid = plan.grid(plan.block_count)
    with stage(progress, "fuse", len(views)) as fusing:
        for i, view in enumerate(views):
            integrate(grid, plan, plan.blocks[i], view, depths[i], None if weights is None else weights[i])
            fusing.advance(i + 1)
    with stage(progress, "extract the mesh", 2) as extracting:
        seen = f"voxels seen by 1, 2, 3, more views: {', '.join(map(str, grid.seen()))}"
        log.debug("fusion: %s", seen)
        vertices, faces, normals, colours = grid.extract(settings.min_views - 0.5)
        del grid  # cleaning the mesh takes memory of its own
        extracting.advance(1)
        if len(faces) == 0:
            raise plan.empty_mesh(f" {seen};")
        keep, faces, dropped = without_small_components(faces, len(vertices), settings.min_component)
        plan.log_dropped(dropped)
        first, faces = in_order(vertices[keep], normals[keep], faces)
        keep = keep[first]
        vertices, normals, colours = plan.in_world(vertices[keep], normals[keep], colours[keep])
        surface = Surface(vertices, faces, normals, colours)
        extracting.advance(2)
    return surface


def integrate(grid: Grid, plan: FusionPlan, blocks: np.ndarray, view: View, depth, weight) -> None:
    """Add a view to `blocks` of the grid, but for what its mask leaves out; nothing where there is no depth."""
    depth = _in_grid(plan, view.camera, depth)
    if depth is None:
        return
    mask = view.load_mask()
    if mask is not None:
        depth = np.where(mask, depth, np.float32(0))
    colour = view.load_image().astype(np.float32) / 255
    for share in _shares(depth, weight, view.name):
        grid.integrate(blocks, share, colour, *_in_frame(plan, view.camera))


@dataclass(frozen=True, eq=False)
class _Weight:
    """The confidence of a DepthResult, at least `least`: an array (H, W) that is made when NumPy needs it."""

    result: object
    least: float

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.maximum(self.result.confidence, self.least).astype(dtype or np.float32, copy=False)


def weights_of(results, least: float) -> list[_Weight] | None:
    """Weights for `fuse`: depths count as far as they are sure, at least `least`; None where all count alike."""
    return None if least == 1 else [_Weight(result, least) for result in results]


def _measured(cameras: list[Camera], depths) -> tuple[float, float, np.ndarray, float, float]:
    """Median footprint, median depth, middle of the points, least and largest depth, from up to 4000 pixels a view."""
    footprints, samples, points, lows, highs = [], [], [], [], []
    for camera, depth in zip(cameras, depths):
        depth = _clean(camera, depth)
        if depth is None or not (depth > 0).any():
            continue
        step = max(1, int(np.sqrt(depth.size / 4000)))
        if not (depth[::step, ::step] > 0).any():
            step = 1
        rows, columns = step * np.array(np.nonzero(depth[::step, ::step] > 0))
        z = depth[rows, columns].astype(np.float64)
        points.append(np.median(camera.rays_at(rows, columns) * z[:, None], axis=0) @ camera.world_to_camera[:3, :3]
                      + camera.center)
        footprints.append(z / np.sqrt(camera.fx * camera.fy))
        samples.append(z)
        lows.append(depth[depth > 0].min())
        highs.append(depth.max())
    if not points:
        raise InputError(f"none of the {len(cameras)} depth maps has a valid depth (finite and above 0): nothing to "
                         "fuse")
    return (float(np.median(np.concatenate(footprints))), float(np.median(np.concatenate(samples))),
            np.median(points, axis=0), float(min(lows)), float(max(highs)))


def _clean(camera: Camera, depth) -> np.ndarray | None:
    """The depth map at the camera's size, clean, scene units."""
    if depth is None:
        return None
    if isinstance(depth, (str, Path)):
        return load_depth(depth, (camera.width, camera.height))
    depth = clean_depth(depth.load() if isinstance(depth, Loads) else depth, f"depth map of {camera.name!r}")
    check_maps([camera], [depth])
    return depth


def _in_grid(plan: FusionPlan, camera: Camera, depth) -> np.ndarray | None:
    """The same in the grid's unit, without pixels so far away that they are too wide; None if none is left."""
    depth, far = _clean(camera, depth), _FAR * plan.voxel * min(camera.fx, camera.fy)
    if depth is None:
        return None
    depth = np.where(depth < far, depth * np.float32(1 / plan.grid_scale), np.float32(0))
    return depth if (depth > 0).any() else None


def _in_frame(plan: FusionPlan, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and world-to-camera for the grid; places are subtracted before the product, to keep their digits."""
    K, rotation = camera.K, camera.world_to_camera[:3, :3]
    K[:2, 2] += grid_shift()
    return K, rigid(rotation, rotation @ ((plan.middle - camera.center) / plan.grid_scale))


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
