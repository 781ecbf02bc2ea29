"""TSDF fusion in less memory than the whole grid takes: space is cut into boxes, one grid after another.

Each box is fused with a margin of one block of the grid around it, where the same depths make the same voxels as in
one grid, and keeps the triangles of its own cells. A cell belongs to exactly one box, so that the pieces fit without a
seam: the same triangles, bit for bit, as from one grid, in another order.
"""

from __future__ import annotations

import logging
import pickle
import tempfile
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, need
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View
from pagas_cl.surface import fuse as whole
from pagas_cl.surface.fuse import FusionPlan, fuse
from pagas_cl.surface.grid import Grid, block_resolution
from pagas_cl.surface.memory import available_mb
from pagas_cl.surface.pieces import in_order
from pagas_cl.surface.seams import join, write_piece
from pagas_cl.surface.touched import Touched, touched_by_views

log = logging.getLogger("pagas_cl")

_SURFACE_BYTES = 72   # a vertex and its two triangles in the mesh that comes out
_PHOTO_BYTES = 40     # a pixel of the view at hand: depth, colours, and what Open3D copies of them (measured)


@dataclass(frozen=True, eq=False)
class Box:
    """Blocks from `low` up to, not including, `high` (three whole numbers each); how many there are with the margin."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]
    blocks: int


@dataclass(frozen=True, eq=False)
class Inputs:
    """What all boxes share."""

    views: list
    depths: list
    weights: list | None
    settings: Fusion
    plan: FusionPlan


@dataclass(frozen=True, eq=False)
class BoxTask:
    """One box to fuse, and the file that gets its piece. `inputs`: the path of a pickle where the task is sent away."""

    inputs: Inputs | Path
    box: Box
    file: Path


def fuse_within(views: list[View], depths, settings: Fusion = Fusion(), memory_mb: float | None = None, *, weights=None,
                progress=None, executor=None, folder=None) -> Surface:
    """Fuse depth maps to a mesh in no more than `memory_mb` of host memory (what is free by default).

    One grid where it fits, else boxes.

    Parameters
    ----------
    views, depths, settings, weights, progress
        As in surface.fuse.fuse. Depths that are paths, and photos that are, are read when they are needed.
    executor : concurrent.futures.Executor, optional
        Fuses boxes elsewhere, `memory_mb` for each; photos and depths must then be on disk, and Open3D where it runs.
    folder : path, optional
        For what is put on disk meanwhile; with an executor on several machines one that all of them see.

    Raises
    ------
    InputError
        As fuse; and where the mesh alone would not fit.
    """
    allowed = available_mb() if memory_mb is None else memory_mb
    with tempfile.TemporaryDirectory(prefix=".fusion-", dir=folder) as scratch:
        scratch = Path(scratch)
        touched = touched_by_views(views, depths, settings, scratch)
        plan = touched.plan
        if plan.memory_mb <= allowed:
            return fuse(views, depths, settings, weights, progress, plan=plan, memory_mb=allowed)
        log.info("%s", plan)
        boxes = cut(touched, settings, allowed, views)
        most = max(_memory_mb(box.blocks, settings) for box in boxes)
        log.info("fusion: %d boxes, at most %.0f MB each, %.0f MB for the mesh, %.0f MB allowed", len(boxes), most,
                 _surface_mb(plan, settings), allowed)
        inputs, files = Inputs(views, depths, weights, settings, plan), []
        if executor is not None:
            (scratch / "inputs.pickle").write_bytes(pickle.dumps(inputs))
            inputs = scratch / "inputs.pickle"
        tasks = [BoxTask(inputs, box, scratch / f"{k:06d}.npz") for k, box in enumerate(boxes)]
        for done, file in enumerate((map if executor is None else executor.map)(fuse_box, tasks), start=1):
            files.append(file)
            if progress:
                progress("fuse", done, len(tasks))
        return join([file for file in files if file is not None], boxes, plan, settings)


def cut(touched: Touched, settings: Fusion, allowed_mb: float, views) -> list[Box]:
    """Boxes whose grids fit, by halving along the longest side at the middle block."""
    pixels = max(view.camera.width * view.camera.height for view in views)
    room = allowed_mb - _surface_mb(touched.plan, settings) - pixels * _PHOTO_BYTES / 1e6
    least = _memory_mb(27, settings)
    if room < least:
        wanted = allowed_mb - room + 20 * least
        raise InputError(f"fusion is allowed {allowed_mb:.0f} MB, and the mesh, one photo and the smallest box take "
                         f"{allowed_mb - room + least:.0f} MB: allow {wanted:.0f} MB, raise fusion.voxel (it is "
                         f"{settings.voxel:g}) or lower fusion.truncation (it is {settings.truncation:g})")
    blocks = touched.blocks
    far = 1 << 20
    boxes, waiting = [], [(blocks, (-far,) * 3, (far,) * 3)]
    while waiting:
        inside, low, high = waiting.pop()
        margin = _within(blocks, low, high, 1)
        count = int(np.count_nonzero(margin))
        sides = np.ptp(inside, axis=0) if len(inside) else np.zeros(3, int)
        if len(inside) == 0:
            continue
        if _memory_mb(count, settings) <= room or sides.max() == 0:
            boxes.append(Box(low, high, count))
            continue
        axis = int(np.argmax(sides))
        at = max(int(np.median(inside[:, axis])), int(inside[:, axis].min()) + 1)
        left = inside[:, axis] < at
        waiting.append((inside[~left], tuple(at if k == axis else v for k, v in enumerate(low)), high))
        waiting.append((inside[left], low, tuple(at if k == axis else v for k, v in enumerate(high))))
    return boxes


def fuse_box(task: BoxTask) -> Path | None:
    """Fuse one box and write its piece of the mesh; None where it holds no triangle."""
    given, box = task.inputs if isinstance(task.inputs, Inputs) else _unpickled(task.inputs), task.box
    plan, settings = given.plan, given.settings
    grid = Grid(plan.voxel / plan.grid_scale, settings.truncation, box.blocks,
                2 * plan.depth_range[1] / plan.grid_scale,
                True,
                need("open3d", "mesh", "fusing depth maps to a mesh"))
    for index, view in enumerate(given.views):
        blocks = plan.blocks[index]
        blocks = blocks[_within(blocks, box.low, box.high, 1)]
        if len(blocks):
            one = replace(plan, blocks={index: blocks})
            weight = None if given.weights is None else given.weights[index]
            whole._integrate(grid, one, index, view, given.depths[index], weight)
    vertices, faces, normals, colours = grid.extract(settings.min_views - 0.5)
    del grid
    edge = block_resolution(settings.truncation) * plan.voxel / plan.grid_scale
    if len(faces):
        middle = np.floor(vertices[faces].mean(axis=1, dtype=np.float64) / edge).astype(np.int64)
        faces = faces[_within(middle, box.low, box.high, 0)]
    if len(faces) == 0:
        return None
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    first, faces = in_order(vertices[used], normals[used], faces)
    keep = used[first]
    write_piece(task.file, vertices[keep], normals[keep], colours[keep], faces.astype(np.int32))
    return task.file


@lru_cache(maxsize=1)
def _unpickled(path: Path) -> Inputs:
    """What this run itself has written."""
    return pickle.loads(path.read_bytes())


def _within(blocks: np.ndarray, low, high, margin: int) -> np.ndarray:
    """Which of `blocks` (N, 3) are in the box, or no more than `margin` blocks outside."""
    return ((blocks >= np.subtract(low, margin)) & (blocks < np.add(high, margin))).all(axis=1)


def _memory_mb(blocks: int, settings: Fusion) -> float:
    """Host memory of fusing so many blocks in one grid."""
    edge = block_resolution(settings.truncation)
    vertices = blocks * edge**2 * whole._VERTICES
    grid = blocks * edge**3 * whole._VOXEL_BYTES + vertices * whole._VERTEX_BYTES
    return max(grid, vertices * whole._AFTER_BYTES) / 1e6


def _surface_mb(plan: FusionPlan, settings: Fusion) -> float:
    return plan.block_count * block_resolution(settings.truncation)**2 * whole._VERTICES * _SURFACE_BYTES / 1e6
