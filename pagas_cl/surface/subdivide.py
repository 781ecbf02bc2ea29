"""Splitting long edges of a triangle mesh in the middle, without cracks, carrying everything that sits on it.

The surface stays the same set of points; original vertices keep their places and come first. What sits on vertices,
corners (texture coordinates with seams) or faces is carried along by the `Subdivision`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.errors import InputError

_ROUNDS = 24
_MOST_VERTICES = 40_000_000  # 3 GB of positions and faces


@dataclass(frozen=True, eq=False)
class Subdivision:
    """How a mesh was subdivided: faces (F', 3), int32; for each round the pairs (E, 2) of vertices between which new
    ones were put, in their order; for each face its parent, the original face that it lies in (F',), and the
    barycentric coordinates of its corners there, weights (F', 3, 3)."""

    faces: np.ndarray = field(repr=False)
    rounds: list[np.ndarray] = field(repr=False)
    parent: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)

    def vertices(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (V, ...) on the new vertices: the mean of the two ends; of whole numbers, the first."""
        for pairs in self.rounds:
            a, b = values[pairs[:, 0]], values[pairs[:, 1]]
            middle = a + (b - a) / 2 if values.dtype.kind == "f" else a
            values = np.concatenate([values, middle.astype(values.dtype)])
        return values

    def corners(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, 3, C), one a corner, on the corners of the new faces."""
        return np.einsum("fij,fjc->fic", self.weights, values[self.parent]).astype(values.dtype)

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, ...) on the new faces: the parent's."""
        return values[self.parent]


def subdivide(vertices: np.ndarray, faces: np.ndarray, longest: np.ndarray, *,
              most: int = _MOST_VERTICES) -> Subdivision:
    """Split every edge that is longer than `longest` at a corner of one of its faces, until none is.

    `longest` (V,) is the longest edge wanted at each vertex of `vertices` (V, 3); infinite leaves edges between such
    vertices alone. InputError where more than `most` vertices would be needed.
    """
    vertices, longest = np.asarray(vertices, np.float64), np.asarray(longest, np.float64)
    faces = np.asarray(faces, np.int64)
    parent, weights = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    rounds: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        edges, of_face = _edges(faces)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        # a face's smallest limit holds for all its edges: else the fan around a corner with a large one never ends
        limit = np.full(len(edges), np.inf)
        np.minimum.at(limit, of_face, longest[faces].min(axis=1)[:, None])
        split = length > limit
        if not split.any():
            return Subdivision(faces.astype(np.int32), rounds, parent, weights)
        if len(vertices) + split.sum() > most:
            raise InputError(f"subdividing to the pixel footprint needs more than {most} vertices; use a coarser "
                             "target (--subdivide with more footprints), or none")
        pairs = edges[split]
        number = np.full(len(edges), -1, np.int64)
        number[split] = len(vertices) + np.arange(len(pairs))
        rounds.append(pairs)
        vertices = np.concatenate([vertices, (vertices[pairs[:, 0]] + vertices[pairs[:, 1]]) / 2])
        longest = np.concatenate([longest, np.minimum(longest[pairs[:, 0]], longest[pairs[:, 1]])])
        faces, parent, weights = _split(faces, number[of_face], parent, weights)
    raise InputError("subdividing did not end: the mesh has edges of very different lengths; remesh it first")


def undivided(faces: np.ndarray, division: Subdivision, vertices: np.ndarray,
              within: np.ndarray) -> tuple[Subdivision, np.ndarray]:
    """The division of `faces` (F, 3) with only those splits that the surface needs: `vertices` (V', 3) are where its
    vertices have gone since. A middle stays where it, or one that hangs on it, lies farther than `within` (V',) from
    the line between the ends of its edge. Gives the coarser division and the old number of each of its vertices."""
    starts = len(vertices) - np.cumsum([len(pairs) for pairs in reversed(division.rounds)])[::-1]
    needed = np.arange(len(vertices)) < (starts[0] if len(starts) else len(vertices))
    for pairs, start in zip(reversed(division.rounds), reversed(starts)):
        a, along = vertices[pairs[:, 0]], vertices[pairs[:, 1]] - vertices[pairs[:, 0]]
        to_middle = vertices[start:start + len(pairs)] - a
        share = (to_middle * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        away = np.linalg.norm(to_middle - np.clip(share, 0, 1)[:, None] * along, axis=1)
        needed[start:start + len(pairs)] |= away > within[start:start + len(pairs)]
        needed[pairs[needed[start:start + len(pairs)]]] = True
    faces, new, rounds = np.asarray(faces, np.int64), np.cumsum(needed) - 1, []
    parent, weights = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    for pairs, start in zip(division.rounds, starts):
        kept = needed[start:start + len(pairs)]
        edges, of_face = _edges(faces)
        known = pairs[kept] @ (len(vertices), 1)     # of each edge its lesser end first, as _edges has it
        order = np.argsort(known)
        place = np.searchsorted(known[order], edges @ (len(vertices), 1))
        place = np.minimum(place, max(len(known) - 1, 0))
        number = np.full(len(edges), -1, np.int64)
        if len(known):
            hit = known[order][place] == edges @ (len(vertices), 1)
            number[hit] = (start + np.flatnonzero(kept))[order][place[hit]]
        rounds.append(new[pairs[kept]])
        faces, parent, weights = _split(faces, number[of_face], parent, weights)
    return Subdivision(new[faces].astype(np.int32), rounds, parent, weights), np.flatnonzero(needed)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unique edges (E, 2), and for each face the numbers of its edges 01, 12, 20."""
    ends = np.sort(np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], axis=1), axis=2).reshape(-1, 2)
    key = ends[:, 0] * (ends[:, 1].max() + 1 if len(ends) else 1) + ends[:, 1]
    _, first, of_face = np.unique(key, return_index=True, return_inverse=True)
    return ends[first], of_face.reshape(-1, 3)


# corners of the new triangles where edges 01; 01 and 12; all three are split: 0 1 2 corners, 3 4 5 middles of 01 12 20
_PATTERNS = {1: ((0, 3, 2), (3, 1, 2)), 2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
             3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}
# which edges are split (bits 1 2 4) -> how often to turn the face so that one of the patterns fits
_TURNS = {1: 0, 2: 1, 4: 2, 3: 0, 6: 1, 5: 2, 7: 0}


def _split(faces, middles, parent, weights):
    """Replace the faces that have middles (F, 3; -1 where an edge stays) by two, three or four."""
    code = (middles >= 0) @ np.array([1, 2, 4])
    parts = [(faces[code == 0], parent[code == 0], weights[code == 0])]
    for value, turns in _TURNS.items():
        chosen = np.flatnonzero(code == value)
        if not len(chosen):
            continue
        order = (np.arange(3) + turns) % 3
        six = np.concatenate([faces[chosen][:, order], middles[chosen][:, order]], axis=1)
        corner = weights[chosen][:, order]
        spots = np.concatenate([corner, (corner + corner[:, [1, 2, 0]]) / 2], axis=1)
        for pattern in _PATTERNS[bin(value).count("1")]:
            parts.append((six[:, pattern], parent[chosen], spots[:, pattern]))
    return tuple(np.concatenate(column) for column in zip(*parts))
