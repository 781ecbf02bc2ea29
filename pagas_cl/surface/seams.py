"""Pieces of a mesh from boxes that touch, joined to one: doubled vertices at the seams become one, flecks go."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.surface.fuse import FusionPlan
from pagas_cl.surface.grid import block_resolution
from pagas_cl.surface.pieces import pieces

log = logging.getLogger("pagas_cl")


@dataclass(frozen=True, eq=False)
class _Piece:
    """What is remembered of a box's piece: its part of the seams and its connected parts."""

    file: Path
    vertices: int
    border: np.ndarray   # indices of vertices near the box's sides
    places: np.ndarray   # where these are
    root: np.ndarray     # their connected part: the least index of its vertices
    sizes: dict          # triangles of each connected part


def join(files: list[Path], boxes, plan: FusionPlan, settings: Fusion) -> Surface:
    """One mesh from the pieces; they are read one at a time."""
    if not files:
        raise InputError(f"fused mesh is empty: depths {plan.depth_range[0]:.4g} to {plan.depth_range[1]:.4g}, voxel "
                         f"{plan.voxel:.4g}, fusion.min_views {settings.min_views}; lower fusion.min_views or raise "
                         "fusion.voxel")
    cell = plan.voxel / plan.unit
    sides = _sides(boxes, block_resolution(settings.truncation) * cell)
    remembered = [_remember(file, sides, 2 * cell) for file in files]
    owner = _owners(remembered)
    stays = _large_parts(remembered, owner, settings.min_component)
    return _assembled(remembered, owner, stays, plan)


def _sides(boxes, edge: float) -> list[np.ndarray]:
    """Where boxes end along each axis, in the grid's unit."""
    ends = [np.unique([box.low[axis] for box in boxes] + [box.high[axis] for box in boxes]) for axis in range(3)]
    return [values[np.abs(values) < (1 << 20)] * edge for values in ends]


def _remember(file: Path, sides, near: float) -> _Piece:
    with np.load(file) as archive:
        vertices, faces = archive["vertices"], archive["faces"]
    root = pieces(faces, len(vertices))
    border = np.zeros(len(vertices), bool)
    for axis in range(3):
        for side in sides[axis]:
            border |= np.abs(vertices[:, axis] - side) < near
    border = np.flatnonzero(border)
    parts, count = np.unique(root[faces[:, 0]], return_counts=True)
    return _Piece(file, len(vertices), border, vertices[border], root[border], dict(zip(parts.tolist(), count.tolist())))


def _owners(remembered: list[_Piece]) -> list[np.ndarray]:
    """For each piece's border: the (piece, vertex) that first has this place, int64 of shape (N, 2)."""
    places = np.concatenate([piece.places for piece in remembered])
    told = np.concatenate([np.column_stack([np.full(len(piece.border), k), piece.border])
                           for k, piece in enumerate(remembered)]).astype(np.int64)
    whole = np.ascontiguousarray(places + np.float32(0))  # -0 is 0
    _, first, same = np.unique(whole.view(np.dtype((np.void, whole.itemsize * 3))).reshape(-1), return_index=True,
                               return_inverse=True)
    owner = told[first[same.reshape(-1)]]
    return np.split(owner, np.cumsum([len(piece.border) for piece in remembered])[:-1])


def _large_parts(remembered, owner, share: float) -> list[set]:
    """For each piece the roots of the connected parts that stay: not smaller than `share` of the largest one."""
    number = {(k, root): n for n, (k, root) in enumerate((k, root) for k, piece in enumerate(remembered)
                                                         for root in piece.sizes)}
    root_at = [dict(zip(piece.border.tolist(), piece.root.tolist())) for piece in remembered]
    links = []
    for k, piece in enumerate(remembered):
        for (other, vertex), root in zip(owner[k].tolist(), piece.root.tolist()):
            if other != k:
                links.append((number[k, root], number[other, root_at[other][vertex]]))
    edges = np.array(sorted(set(links)), np.int64).reshape(-1, 2)
    label = pieces(np.column_stack([edges, edges[:, :1]]), len(number))
    size = np.zeros(len(number), np.int64)
    counts = np.array([piece.sizes[root] for piece in remembered for root in piece.sizes], np.int64)
    np.add.at(size, label, counts)
    large = size[label] >= share * size.max()
    dropped = len(np.unique(label)) - len(np.unique(label[large]))
    if dropped:
        log.info("fusion: %d pieces with fewer than %g of the largest one's triangles are dropped", dropped, share)
    return [{root for root in piece.sizes if large[number[k, root]]} for k, piece in enumerate(remembered)]


def _assembled(remembered, owner, stays, plan: FusionPlan) -> Surface:
    """The mesh, its arrays made once at their full size."""
    kept = [_kept(piece, owner[k], k, stays[k]) for k, piece in enumerate(remembered)]
    starts = np.cumsum([0] + [int(own.sum()) for own, _ in kept])
    total = sum(count for _, count in kept)
    vertices, faces = np.empty((starts[-1], 3)), np.empty((total, 3), np.int32)
    normals, colours = (np.empty((starts[-1], 3), np.float32) for _ in range(2))
    new, at = [], 0
    for k, piece in enumerate(remembered):
        own = kept[k][0]
        number = np.cumsum(own) - 1 + starts[k]
        for_border = piece.border
        new.append(dict(zip(for_border.tolist(), number[for_border].tolist())))
        shared = owner[k][:, 0] != k
        number[for_border[shared]] = [new[other].get(vertex, -1) for other, vertex in owner[k][shared].tolist()]
        with np.load(piece.file) as archive:
            rows = slice(starts[k], starts[k + 1])
            vertices[rows] = archive["vertices"][own].astype(np.float64) * plan.unit + plan.middle
            normal = archive["normals"][own]
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            normals[rows] = normal / np.where(length > 0, length, 1)
            colours[rows] = np.clip(archive["colours"][own], 0, 1)
            part = archive["faces"]
        part = part[np.isin(pieces(part, piece.vertices)[part[:, 0]], list(stays[k]))]
        faces[at:at + len(part)] = number[part]
        at += len(part)
    return Surface(vertices, faces, normals, colours)


def _kept(piece: _Piece, owner: np.ndarray, k: int, stays: set) -> tuple[np.ndarray, int]:
    """Which vertices this piece gives to the mesh, and how many triangles."""
    with np.load(piece.file) as archive:
        root = pieces(archive["faces"], piece.vertices)
    own = np.isin(root, list(stays))
    own[piece.border[owner[:, 0] != k]] = False
    return own, sum(piece.sizes[root] for root in stays)
