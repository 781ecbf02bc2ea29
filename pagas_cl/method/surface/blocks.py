"""TSDF fusion in less memory than the whole grid takes: space is cut into boxes, one grid after another.

Each box has a margin of one block, where the same depths make the same voxels as in one grid, and keeps the triangles
of its own cells. A cell is in exactly one box: the meshes of the boxes fit without a seam, the same triangles, bit for
bit, as from one grid, in another order; at the seams doubled vertices become one.
"""

import pickle
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, log
from pagas_cl.method.surface.fuse import (
    FusionPlan,
    available_mb,
    empty_mesh,
    fuse,
    grid_mb,
    in_world,
    integrate,
    log_dropped,
    mesh_mb,
    plan_with_blocks,
)
from pagas_cl.method.surface.grid import block_resolution
from pagas_cl.method.surface.weld import connected_components, in_order
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View

USUAL_MB = 600.0     # of host memory where nobody says how much: what a photo and a mesh leave goes to the grid
_NEAR = 0.1           # voxels: a vertex that two boxes share lies on the side between them
_NAMES = "vertices", "normals", "colours", "faces", "component"      # of the mesh of a box, in its file
_PHOTO_BYTES = 40     # a pixel of the view at hand: depth, colours, and what Open3D copies of them (measured)


class BlockFiles(Sequence):
    """Blocks of each view, int32 of shape (N, 3), in files below `folder`, read when they are indexed."""

    def __init__(self, folder: Path):
        self.folder, self._count = folder, 0

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> np.ndarray:
        return np.load(self.folder / f"blocks{index:06d}.npy")

    def append(self, blocks: np.ndarray) -> None:
        np.save(self.folder / f"blocks{self._count:06d}.npy", blocks)
        self._count += 1


@dataclass(frozen=True, eq=False)
class Box:
    """Blocks from `low` up to, not including, `high` (three whole numbers each); how many there are with the margin."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]
    blocks: int


def fuse_within(views: list[View], depths, settings: Fusion = Fusion(), memory_mb: float | None = None, *, weights=None,
                progress: Progress = NONE, executor=None, folder=None) -> Surface:
    """Fuse depth maps to a mesh in at most `memory_mb` of host memory, in boxes if need be. By default in some 600 MB,
    or what the mesh itself takes, of what is free, and with the bytes that one grid gives.

    As surface.fuse.fuse. An `executor` (concurrent.futures) fuses boxes in other processes, `memory_mb` for each;
    photos and depths must then be on disk, and Open3D where it runs. `folder` is for what is put on disk meanwhile; all
    machines must see it. InputError also where the mesh alone would not fit.
    """
    with tempfile.TemporaryDirectory(prefix=".fusion-", dir=folder) as scratch:
        scratch = Path(scratch)
        plan, blocks = plan_with_blocks(views, depths, settings, BlockFiles(scratch), progress)
        allowed = min(available_mb(), max(USUAL_MB, 2 * mesh_mb(plan))) if memory_mb is None else memory_mb
        if plan.memory_mb <= allowed:
            return fuse(views, depths, settings, weights, progress, plan=plan, memory_mb=allowed)
        log.debug("%s", plan)
        boxes = cut(plan, blocks, allowed, views)
        most = max(grid_mb(box.blocks, settings) for box in boxes)
        log.debug("fusion: %d boxes, at most %.0f MB each, %.0f MB for the mesh, %.0f MB allowed", len(boxes), most,
                  mesh_mb(plan), allowed)
        inputs, files = (views, depths, weights, plan), []
        if executor is not None:
            (scratch / "inputs.pickle").write_bytes(pickle.dumps(inputs))
            inputs = scratch / "inputs.pickle"
        tasks = [(box, scratch / f"{k:06d}.npz") for k, box in enumerate(boxes)]
        run = map if executor is None else executor.map
        with stage(progress, "fuse", len(tasks)) as fusing:
            for file in run(partial(fuse_box, inputs), tasks):
                files.append(file)
                fusing.advance(len(files))
        with stage(progress, "extract the mesh", 1) as extracting:
            whole = join([file for file in files if file is not None], boxes, plan, memory_mb is None)
            extracting.advance(1)
        return whole


def cut(plan: FusionPlan, blocks: np.ndarray, allowed_mb: float, views) -> list[Box]:
    """Boxes of `blocks` (N, 3) whose grids fit, by halving along the longest side at the middle block."""
    settings, pixels = plan.settings, max(view.camera.width * view.camera.height for view in views)
    room = allowed_mb - mesh_mb(plan) - pixels * _PHOTO_BYTES / 1e6
    least = grid_mb(27, settings)
    if room < least:
        wanted = allowed_mb - room + 20 * least
        raise InputError(f"fusion is allowed {allowed_mb:.0f} MB, and the mesh, one photo and the smallest box take "
                         f"{allowed_mb - room + least:.0f} MB: allow {wanted:.0f} MB, raise fusion.voxel (it is "
                         f"{settings.voxel:g}) or lower fusion.truncation (it is {settings.truncation:g})")
    far = 1 << 20
    boxes, waiting = [], [(blocks, (-far,) * 3, (far,) * 3)]
    while waiting:
        inside, low, high = waiting.pop()
        if len(inside) == 0:
            continue
        count = int(np.count_nonzero(within(blocks, low, high, 1)))
        sides = np.ptp(inside, axis=0)
        if grid_mb(count, settings) <= room or sides.max() == 0:
            boxes.append(Box(low, high, count))
            continue
        axis = int(np.argmax(sides))
        at = max(int(np.median(inside[:, axis])), int(inside[:, axis].min()) + 1)
        left = inside[:, axis] < at
        waiting.append((inside[~left], (*low[:axis], at, *low[axis + 1:]), high))
        waiting.append((inside[left], low, (*high[:axis], at, *high[axis + 1:])))
    return boxes


def fuse_box(inputs: tuple | Path, task: tuple[Box, Path]) -> Path | None:
    """Fuse a box and write its part of the mesh to a file; None where it holds no triangle.

    `inputs` are what all boxes share (views, depths, weights, plan), or a pickle of it.
    """
    views, depths, weights, plan = _unpickled(inputs) if isinstance(inputs, Path) else inputs
    (box, file), grid = task, plan.grid(task[0].blocks)
    for index, view in enumerate(views):
        blocks = plan.blocks[index]
        blocks = blocks[within(blocks, box.low, box.high, 1)]
        if len(blocks):
            integrate(grid, plan, blocks, view, depths[index], None if weights is None else weights[index])
    vertices, faces, normals, colours = grid.extract(plan.settings.min_views - 0.5)
    del grid
    edge = block_resolution(plan.settings.truncation) * plan.voxel / plan.grid_scale
    if len(faces):
        middle = np.floor(vertices[faces].mean(axis=1, dtype=np.float64) / edge).astype(np.int64)
        faces = faces[within(middle, box.low, box.high, 0)]
    if len(faces) == 0:
        return None
    used, faces = np.unique(faces, return_inverse=True)
    first, faces = in_order(vertices[used], normals[used], faces.reshape(-1, 3))
    keep = used[first]
    faces = faces.astype(np.int32)
    component = connected_components(faces, len(keep)).astype(np.int32)
    with open(file, "wb") as opened:
        np.savez(opened, **dict(zip(_NAMES, (vertices[keep], normals[keep], colours[keep], faces, component))))
    return file


@lru_cache(maxsize=1)
def _unpickled(path: Path) -> tuple:
    """What this run itself has written."""
    return pickle.loads(path.read_bytes())


def within(blocks: np.ndarray, low, high, margin: int) -> np.ndarray:
    """Which of `blocks` (N, 3) are in the box, or no more than `margin` blocks outside."""
    return ((blocks >= np.subtract(low, margin)) & (blocks < np.add(high, margin))).all(axis=1)


def join(files: list[Path], boxes, plan: FusionPlan, ordered: bool = False) -> Surface:
    """One mesh from those of the boxes. `ordered`: vertices and faces as one grid would have them, which takes more
    memory."""
    if not files:
        raise empty_mesh(plan)
    parts = [_loaded(file) for file in files]
    for part, start in zip(parts, np.cumsum([0, *(len(part["vertices"]) for part in parts)])):
        part["faces"] += start
        part["component"] += start
    vertices, normals, colours, faces, component = (np.concatenate([part.pop(name) for part in parts])
                                                    for name in _NAMES)
    border = _on_sides(vertices, boxes, plan)
    first = np.arange(len(vertices), dtype=np.int32)        # of the vertices at one place, which two boxes may have
    first[border] = border[_first_rows(vertices[border])]
    links = np.column_stack([component[border], component[first[border]], component[border]])
    component = connected_components(links, len(vertices))[component]
    size = np.bincount(component[faces[:, 0]], minlength=len(vertices))
    large = size >= plan.settings.min_component * size.max()
    log_dropped(int(np.count_nonzero((size > 0) & ~large)), plan.settings)
    stays = large[component]
    faces = first[faces[stays[faces[:, 0]]]]
    stays &= first == np.arange(len(first))
    faces = (np.cumsum(stays, dtype=np.int32) - 1)[faces]
    vertices, normals, colours = vertices[stays], normals[stays], colours[stays]
    if ordered:
        keep, faces = in_order(vertices, normals, faces)
        vertices, normals, colours = vertices[keep], normals[keep], colours[keep]
    vertices, normals, colours = in_world(plan, vertices, normals, colours)
    return Surface(vertices, faces, normals, colours)


def _loaded(file: Path) -> dict[str, np.ndarray]:
    with np.load(file) as archive:
        return dict(archive)


def _on_sides(vertices: np.ndarray, boxes, plan: FusionPlan) -> np.ndarray:
    """Which vertices (V, 3) in the grid's unit lie on sides of boxes: indices int32."""
    cell = plan.voxel / plan.grid_scale
    edge = block_resolution(plan.settings.truncation) * cell
    on_side = np.zeros(len(vertices), bool)
    for axis, places in enumerate(vertices.T):
        nearest = np.rint(places / edge)
        ends = [end for box in boxes for end in (box.low[axis], box.high[axis])]
        on_side |= np.isin(nearest, ends) & (np.abs(places - nearest * edge) < _NEAR * cell)
    return np.flatnonzero(on_side).astype(np.int32)


def _first_rows(places: np.ndarray) -> np.ndarray:
    """For each border vertex of all boxes, in order, the first one at the same place: int64 of shape (N,)."""
    whole = np.ascontiguousarray(places + np.float32(0))  # -0 is 0
    _, first, same = np.unique(whole.view(np.dtype((np.void, whole.itemsize * 3))).reshape(-1), return_index=True,
                               return_inverse=True)
    return first[same.reshape(-1)]
