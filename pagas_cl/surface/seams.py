"""Pieces of a mesh from boxes that touch, joined to one: doubled vertices at the seams become one, flecks go."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.scene.mesh import Surface
from pagas_cl.surface.fuse import FusionPlan, empty_mesh, in_world, tell_dropped
from pagas_cl.surface.grid import block_resolution
from pagas_cl.surface.pieces import pieces

_NEAR = 0.1  # voxels: a vertex that two boxes share lies on the side between them


@dataclass(frozen=True, eq=False)
class _Piece:
    """What is remembered of a box's piece of the mesh."""

    file: Path
    border: np.ndarray        # (B,) int32: indices of the vertices on the box's sides
    border_part: np.ndarray   # (B,) int32: their connected part, a place in `parts`
    parts: np.ndarray         # (P,) int32: the least vertex index of each connected part
    sizes: np.ndarray         # (P,) int64: triangles of each


def write_piece(file: Path, vertices, normals, colours, faces) -> None:
    """Write a box's piece, with the connected part of each vertex: the least index of its vertices."""
    root = pieces(faces, len(vertices)).astype(np.int32)
    with open(file, "wb") as opened:
        np.savez(opened, vertices=vertices, normals=normals, colours=colours, faces=faces, root=root)


def join(files: list[Path], boxes, plan: FusionPlan) -> Surface:
    """One mesh from the pieces; they are read one at a time."""
    if not files:
        raise empty_mesh(plan)
    cell = plan.voxel / plan.grid_scale
    sides = _sides(boxes, block_resolution(plan.settings.truncation) * cell)
    remembered, places = zip(*(_remember(file, sides, _NEAR * cell) for file in files))
    first = _first_rows(np.concatenate(places))
    large = _large_parts(remembered, first, plan.settings)
    return _assembled(remembered, first, large, plan)


def _sides(boxes, edge: float) -> list[np.ndarray]:
    """Where boxes end along each axis, in the grid's unit."""
    ends = [np.unique([box.low[axis] for box in boxes] + [box.high[axis] for box in boxes]) for axis in range(3)]
    return [values[np.abs(values) < (1 << 20)] * edge for values in ends]


def _remember(file: Path, sides, near: float) -> tuple[_Piece, np.ndarray]:
    """The piece, and where its border vertices are: float32 of shape (B, 3)."""
    with np.load(file) as archive:
        vertices, root, faces = archive["vertices"], archive["root"], archive["faces"]
    on_side = np.zeros(len(vertices), bool)
    for axis in range(3):
        if len(sides[axis]):
            at = np.searchsorted(sides[axis], vertices[:, axis])
            for neighbour in (np.maximum(at - 1, 0), np.minimum(at, len(sides[axis]) - 1)):
                on_side |= np.abs(vertices[:, axis] - sides[axis][neighbour]) < near
    border = np.flatnonzero(on_side).astype(np.int32)
    parts, sizes = np.unique(root[faces[:, 0]], return_counts=True)
    return _Piece(file, border, np.searchsorted(parts, root[border]).astype(np.int32), parts, sizes), vertices[border]


def _first_rows(places: np.ndarray) -> np.ndarray:
    """For each border vertex of all pieces, in order, the first one at the same place: int64 of shape (N,)."""
    whole = np.ascontiguousarray(places + np.float32(0))  # -0 is 0
    _, first, same = np.unique(whole.view(np.dtype((np.void, whole.itemsize * 3))).reshape(-1), return_index=True,
                               return_inverse=True)
    return first[same.reshape(-1)]


def _large_parts(remembered, first: np.ndarray, settings: Fusion) -> list[np.ndarray]:
    """For each piece which of its parts stay: with what they touch not too small beside the largest one."""
    offsets = np.cumsum([0] + [len(piece.parts) for piece in remembered])
    part = np.concatenate([piece.border_part + offset for piece, offset in zip(remembered, offsets)])
    links = np.unique(np.column_stack([part, part[first]]), axis=0)
    links = links[links[:, 0] != links[:, 1]].reshape(-1, 2)
    label = pieces(np.column_stack([links, links[:, :1]]), int(offsets[-1]))
    size = np.zeros(offsets[-1], np.int64)
    np.add.at(size, label, np.concatenate([piece.sizes for piece in remembered]))
    large = size[label] >= settings.min_component * size.max()
    tell_dropped(len(np.unique(label[~large])), settings)
    return np.split(large, offsets[1:-1])


def _assembled(remembered, first: np.ndarray, large, plan: FusionPlan) -> Surface:
    """The mesh, its arrays made once at their full size."""
    rows = np.cumsum([0] + [len(piece.border) for piece in remembered])
    counted = [_own(piece, first[rows[k]:rows[k + 1]] < rows[k], large[k]) for k, piece in enumerate(remembered)]
    starts = np.cumsum([0] + [count for count, _ in counted])
    vertices, normals, colours = (np.empty((starts[-1], 3), kind) for kind in (np.float64, np.float32, np.float32))
    faces, at = np.empty((sum(count for _, count in counted), 3), np.int32), 0
    number_of_row = np.full(len(first), -1, np.int32)
    for k, piece in enumerate(remembered):
        here, shared = slice(rows[k], rows[k + 1]), first[rows[k]:rows[k + 1]] < rows[k]
        with np.load(piece.file) as archive:
            own, stays = _kept(archive["root"], piece, shared, large[k])
            number = (np.cumsum(own) - 1 + starts[k]).astype(np.int32)
            number[piece.border[shared]] = number_of_row[first[here][shared]]
            number_of_row[here] = number[piece.border]
            place = slice(starts[k], starts[k + 1])
            vertices[place], normals[place], colours[place] = in_world(
                plan, *(archive[name][own] for name in ("vertices", "normals", "colours")))
            part = archive["faces"]
        part = part[stays[part[:, 0]]]
        faces[at:at + len(part)] = number[part]
        at += len(part)
    return Surface(vertices, faces, normals, colours)


def _own(piece: _Piece, shared: np.ndarray, large: np.ndarray) -> tuple[int, int]:
    """How many vertices and triangles this piece gives to the mesh."""
    with np.load(piece.file) as archive:
        own, _ = _kept(archive["root"], piece, shared, large)
    return int(np.count_nonzero(own)), int(piece.sizes[large].sum())


def _kept(root: np.ndarray, piece: _Piece, shared: np.ndarray, large: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices are given by this piece and not by an earlier one, and which are in a part that stays."""
    stays = large[np.searchsorted(piece.parts, root)]
    own = stays.copy()
    own[piece.border[shared]] = False
    return own, stays
