"""TSDF fusion in less memory than the whole grid takes: space is cut into boxes, one grid after another.

Each box has a margin of one block, where the same depths make the same voxels as in one grid, and keeps the triangles
of its own cells. A cell is in exactly one box: the meshes of the boxes fit without a seam, the same triangles, bit for
bit, as from one grid, in another order; at the seams doubled vertices become one."""

import pickle
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, log
from pagas_cl.method.surface.fuse import FusionPlan, fuse, grid_mb, integrate, plan_with_blocks
from pagas_cl.method.surface.grid import block_resolution
from pagas_cl.method.surface.weld import connected_components, in_order
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.runtime.host import available_mb
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View

USUAL_MB = 600.0     # of host memory where nobody says how much: what a photo and a mesh leave goes to the grid
_NEAR = 0.1           # voxels: a vertex that two boxes share lies on the side between them
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
    machines must see it. InputError also where the mesh alone would not fit."""
    with tempfile.TemporaryDirectory(prefix=".fusion-", dir=folder) as scratch:
        scratch = Path(scratch)
        plan, blocks = plan_with_blocks(views, depths, settings, BlockFiles(scratch), progress)
        allowed = min(available_mb(), max(USUAL_MB, 2 * plan.mesh_mb)) if memory_mb is None else memory_mb
        if plan.memory_mb <= allowed:
            return fuse(views, depths, settings, weights, progress, plan=plan, memory_mb=allowed)
        log.debug("%s", plan)
        boxes = cut(plan, blocks, allowed, views)
        most = max(grid_mb(box.blocks, settings) for box in boxes)
        log.debug("fusion: %d boxes, at most %.0f MB each, %.0f MB for the mesh, %.0f MB allowed", len(boxes), most,
                  plan.mesh_mb, allowed)
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
    settings, pixels = plan.settings, max(view.camera.size.pixels for view in views)
    room = allowed_mb - plan.mesh_mb - pixels * _PHOTO_BYTES / 1e6
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
    """Fuse a box and write its part of the mesh to a file; None where it holds no triangle. `inputs` are what all boxes
    share (views, depths, weights, plan), or a pickle of it."""
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
        np.savez(opened, vertices=vertices[keep], normals=normals[keep], colours=colours[keep], faces=faces,
                 component=component)
    return file


@lru_cache(maxsize=1)
def _unpickled(path: Path) -> tuple:
    """What this run itself has written."""
    return pickle.loads(path.read_bytes())


def within(blocks: np.ndarray, low, high, margin: int) -> np.ndarray:
    """Which of `blocks` (N, 3) are in the box, or no more than `margin` blocks outside."""
    return ((blocks >= np.subtract(low, margin)) & (blocks < np.add(high, margin))).all(axis=1)


@dataclass(frozen=True, eq=False)
class _BoxMesh:
    file: Path
    border: np.ndarray        # (B,) int32: indices of the vertices on the box's sides
    border_component: np.ndarray     # (B,) int32: theirs, a place in `components`
    components: np.ndarray    # (C,) int32: the least vertex index of each connected component
    sizes: np.ndarray         # (C,) int64: triangles of each
    vertices: np.ndarray      # (C,) int64: vertices of each


def join(files: list[Path], boxes, plan: FusionPlan, ordered: bool = False) -> Surface:
    """One mesh from those of the boxes; they are read one at a time. `ordered`: vertices and faces as one grid would
    have them, which takes more memory."""
    if not files:
        raise plan.empty_mesh()
    cell = plan.voxel / plan.grid_scale
    edge = block_resolution(plan.settings.truncation) * cell
    ends = [np.unique([(box.low[axis], box.high[axis]) for box in boxes]) for axis in range(3)]
    sides = [values[np.abs(values) < (1 << 20)] * edge for values in ends]      # along each axis, in the grid's unit
    remembered, places = zip(*(_remember(file, sides, _NEAR * cell) for file in files))
    first = _first_rows(np.concatenate(places))
    large = _large_components(remembered, first, plan)
    vertices, faces, normals, colours = _assembled(remembered, first, large)
    if ordered:
        keep, faces = in_order(vertices, normals, faces)
        vertices, normals, colours = vertices[keep], normals[keep], colours[keep]
    vertices, normals, colours = plan.in_world(vertices, normals, colours)      # those of the grid go before the rest
    return Surface(vertices, faces, normals, colours)


def _remember(file: Path, sides, near: float) -> tuple[_BoxMesh, np.ndarray]:
    """The mesh of a box, and where its border vertices are: float32 of shape (B, 3)."""
    with np.load(file) as archive:
        vertices, component, faces = archive["vertices"], archive["component"], archive["faces"]
    on_side = np.zeros(len(vertices), bool)
    for axis in range(3):
        if len(sides[axis]):
            at = np.searchsorted(sides[axis], vertices[:, axis])
            for neighbour in (np.maximum(at - 1, 0), np.minimum(at, len(sides[axis]) - 1)):
                on_side |= np.abs(vertices[:, axis] - sides[axis][neighbour]) < near
    border = np.flatnonzero(on_side).astype(np.int32)
    components, sizes = np.unique(component[faces[:, 0]], return_counts=True)
    place = np.searchsorted(components, component).astype(np.int32)
    return _BoxMesh(file, border, place[border], components, sizes, np.bincount(place)), vertices[border]


def _first_rows(places: np.ndarray) -> np.ndarray:
    """For each border vertex of all boxes, in order, the first one at the same place: int64 of shape (N,)."""
    whole = np.ascontiguousarray(places + np.float32(0))  # -0 is 0
    _, first, same = np.unique(whole.view(np.dtype((np.void, whole.itemsize * 3))).reshape(-1), return_index=True,
                               return_inverse=True)
    return first[same.reshape(-1)]


def _large_components(remembered, first: np.ndarray, plan: FusionPlan) -> list[np.ndarray]:
    """For each box which components stay: with what they touch not too small compared with the largest one."""
    offsets = np.cumsum([0] + [len(box_mesh.components) for box_mesh in remembered])
    component = np.concatenate([box_mesh.border_component + offset for box_mesh, offset in zip(remembered, offsets)])
    links = np.unique(np.column_stack([component, component[first]]), axis=0)
    links = links[links[:, 0] != links[:, 1]].reshape(-1, 2)
    label = connected_components(np.column_stack([links, links[:, :1]]), int(offsets[-1]))
    size = np.zeros(offsets[-1], np.int64)
    np.add.at(size, label, np.concatenate([box_mesh.sizes for box_mesh in remembered]))
    large = size[label] >= plan.settings.min_component * size.max()
    plan.log_dropped(len(np.unique(label[~large])))
    return np.split(large, offsets[1:-1])


def _assembled(remembered, first: np.ndarray, large) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces, normals, colours in the grid's unit; a vertex of several boxes is given by the first."""
    rows = np.cumsum([0] + [len(box_mesh.border) for box_mesh in remembered])
    shared = [first[begin:end] < begin for begin, end in zip(rows, rows[1:])]
    counts = [box_mesh.vertices[stays].sum() - np.count_nonzero(stays[box_mesh.border_component[given]])
              for box_mesh, stays, given in zip(remembered, large, shared)]
    starts = np.cumsum([0, *counts])
    vertices, normals, colours = (np.empty((starts[-1], 3), np.float32) for _ in range(3))
    total = sum(box_mesh.sizes[stays].sum() for box_mesh, stays in zip(remembered, large))
    faces, at = np.empty((total, 3), np.int32), 0
    number_of_row = np.full(len(first), -1, np.int32)
    for k, box_mesh in enumerate(remembered):
        here, place = slice(rows[k], rows[k + 1]), slice(starts[k], starts[k + 1])
        with np.load(box_mesh.file) as archive:
            stays = large[k][np.searchsorted(box_mesh.components, archive["component"])]
            own = stays.copy()
            own[box_mesh.border[shared[k]]] = False
            number = (np.cumsum(own) - 1 + starts[k]).astype(np.int32)
            number[box_mesh.border[shared[k]]] = number_of_row[first[here][shared[k]]]
            number_of_row[here] = number[box_mesh.border]
            for whole, name in ((vertices, "vertices"), (normals, "normals"), (colours, "colours")):
                whole[place] = archive[name][own]
            part = archive["faces"]
        part = part[stays[part[:, 0]]]
        faces[at:at + len(part)] = number[part]
        at += len(part)
    return vertices, faces, normals, colours
