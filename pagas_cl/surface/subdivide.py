"""Splitting edges of a triangle mesh in the middle, without cracks, carrying everything that sits on it.

The surface stays the same set of points; original vertices keep their places and come first. What sits on vertices,
corners (texture coordinates with seams) or faces is carried along by the `Subdivision`. Vertices at one place, as
seams have them, are one for what is split and what is kept (`place`), so that seams do not open.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.errors import InputError

_ROUNDS = 24
_MOST_VERTICES = 40_000_000  # 3 GB of positions and faces


@dataclass(frozen=True, eq=False)
class Subdivision:
    """How a mesh of `count` vertices was subdivided: its faces (F, 3) before and (F', 3) after, int32, and for each
    round the pairs (E, 2) of vertices between which new ones were put, in their order."""

    count: int
    given: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    rounds: list[np.ndarray] = field(repr=False)

    def vertices(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (V, ...) on the new vertices: the mean of the two ends; of whole numbers, the first."""
        for pairs in self.rounds:
            values = with_middles(values, pairs)
        return values

    def corners(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, 3, C), one a corner, on the corners of the new faces."""
        return self._carried(values.astype(np.float64)).astype(values.dtype)

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, ...) on the new faces: the parent's."""
        return values[self._carried(np.arange(len(self.given)))]

    def _carried(self, values: np.ndarray) -> np.ndarray:
        """The rounds once more, with `values` on faces (F,) or on their corners (F, 3, C)."""
        faces, start, count = self.given, self.count, self.count + sum(map(len, self.rounds))
        for pairs in self.rounds:
            faces, values = split(faces, numbers_of(faces, pairs, start + np.arange(len(pairs)), count), values)
            start += len(pairs)
        return values


def with_middles(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Values (V, ...) of vertices, and after them those in the middles of `pairs` (E, 2); of whole numbers, the
    first's."""
    a, b = values[pairs[:, 0]], values[pairs[:, 1]]
    middle = a + (b - a) / 2 if values.dtype.kind == "f" else a
    return np.concatenate([values, middle.astype(values.dtype)])


def long_edges(vertices: np.ndarray, faces: np.ndarray, longest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges longer than `longest` (V,) at both ends: ends (E, 2) int64, the lesser first, and of each face's sides 01,
    12, 20 the number of its edge, (F, 3), -1 where it is no longer than that."""
    key = np.full(faces.shape, -1, np.int64)
    for side in range(3):
        a, b = faces[:, side], faces[:, (side + 1) % 3]
        long = np.flatnonzero(np.linalg.norm(vertices[a] - vertices[b], axis=1) > np.maximum(longest[a], longest[b]))
        key[long, side] = _keys(a[long], b[long], len(vertices))
    found, number = np.unique(key, return_inverse=True)
    less = int(len(found) and found[0] < 0)
    return np.stack(np.divmod(found[less:], len(vertices)), axis=1), number.reshape(-1, 3) - less


def spread(longest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The least of `longest` (V,) among the corners of the faces around each vertex: a face that is seen in part is
    split as a whole."""
    around = longest.copy()
    np.minimum.at(around, faces, longest[faces].min(axis=1)[:, None])
    return around


def subdivide(vertices: np.ndarray, faces: np.ndarray, longest: np.ndarray, *,
              most: int = _MOST_VERTICES) -> Subdivision:
    """Split every edge that is longer than `longest` at both ends, until none is.

    `longest` (V,) is the longest edge wanted at each vertex of `vertices` (V, 3), and around it (see spread); infinite
    leaves edges alone. InputError where more than `most` vertices would be needed.
    """
    vertices, longest = np.asarray(vertices, np.float64), np.asarray(longest, np.float64)
    given, rounds, count = np.asarray(faces, np.int32), [], len(vertices)
    faces, longest = given, spread(longest, given)
    for _ in range(_ROUNDS):
        pairs, of_face = long_edges(vertices, faces, longest)
        if not len(pairs):
            return Subdivision(count, given, faces, rounds)
        if len(vertices) + len(pairs) > most:
            raise InputError(f"subdividing to the pixel footprint needs more than {most} vertices; use a coarser "
                             "target (--subdivide with more footprints), or none")
        faces, _ = split(faces, np.where(of_face < 0, -1, of_face + len(vertices)))
        rounds.append(pairs.astype(np.int32))
        vertices = with_middles(vertices, pairs)
        longest = np.concatenate([longest, np.minimum(longest[pairs[:, 0]], longest[pairs[:, 1]])])
    raise InputError("subdividing did not end: the mesh has edges of very different lengths; remesh it first")


def undivided(division: Subdivision, vertices: np.ndarray, within: np.ndarray,
              place: np.ndarray | None = None) -> tuple[Subdivision, np.ndarray]:
    """The division with only those splits that the surface needs: `vertices` (V', 3) are where its vertices have gone
    since. A middle stays where it, or one that hangs on it, lies farther than `within` (V',) from the line between the
    ends of its edge; vertices with the same `place` (V',) stay together. Gives the coarser division and the old number
    of each of its vertices."""
    count, lengths = len(vertices), [len(pairs) for pairs in division.rounds]
    starts = division.count + np.cumsum([0, *lengths])[:-1]
    needed = np.arange(count) < division.count
    for pairs, start in zip(reversed(division.rounds), reversed(starts.tolist())):
        middle = slice(start, start + len(pairs))
        a, along = vertices[pairs[:, 0]], vertices[pairs[:, 1]] - vertices[pairs[:, 0]]
        to_middle = vertices[middle] - a
        share = (to_middle * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        needed[middle] |= np.linalg.norm(to_middle - np.clip(share, 0, 1)[:, None] * along, axis=1) > within[middle]
        if place is not None:
            needed[middle] = np.isin(place[middle], place[middle][needed[middle]])
        needed[pairs[needed[middle]]] = True
    new, faces, rounds = np.cumsum(needed) - 1, division.given, []
    for pairs, start in zip(division.rounds, starts):
        kept = needed[start:start + len(pairs)]
        faces, _ = split(faces, numbers_of(faces, pairs[kept], start + np.flatnonzero(kept), count))
        rounds.append(new[pairs[kept]].astype(np.int32))
    coarser = Subdivision(division.count, division.given, new[faces].astype(np.int32), rounds)
    return coarser, np.flatnonzero(needed)


def numbers_of(faces: np.ndarray, pairs: np.ndarray, numbers: np.ndarray, count: int) -> np.ndarray:
    """Of each face's sides 01, 12, 20 the number (F, 3) of that of the `pairs` (E, 2) of `count` vertices that it is,
    -1 where it is none."""
    known = _keys(pairs[:, 0], pairs[:, 1], count)
    order = np.argsort(known)
    known, found = known[order], np.full(faces.shape, -1, np.int64)
    for side in range(3 if len(known) else 0):
        asked = _keys(faces[:, side], faces[:, (side + 1) % 3], count)
        at = np.minimum(np.searchsorted(known, asked), len(known) - 1)
        found[:, side] = np.where(known[at] == asked, numbers[order[at]], -1)
    return found


def _keys(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    keys: np.ndarray = np.minimum(a, b).astype(np.int64) * count + np.maximum(a, b)
    return keys


# corners of the new triangles where edges 01; 01 and 12; all three are split: 0 1 2 corners, 3 4 5 middles of 01 12 20
_PATTERNS = {1: ((0, 3, 2), (3, 1, 2)), 2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
             3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}
# which edges are split (bits 1 2 4) -> how often to turn the face so that one of the patterns fits
_TURNS = {1: 0, 2: 1, 4: 2, 3: 0, 6: 1, 5: 2, 7: 0}


def split(faces: np.ndarray, middles: np.ndarray, values: np.ndarray | None = None):
    """Replace the faces (F, 3) that have middles (F, 3; -1 where an edge stays) by two, three or four. With them go
    `values` on faces (F,) or their corners (F, 3, C)."""
    code = (middles >= 0) @ np.array([1, 2, 4])
    parts, carried = [faces[code == 0]], [None if values is None else values[code == 0]]
    for value, turns in _TURNS.items():
        chosen = np.flatnonzero(code == value)
        if not len(chosen):
            continue
        order = (np.arange(3) + turns) % 3
        six = np.concatenate([faces[chosen][:, order], middles[chosen][:, order].astype(faces.dtype)], axis=1)
        spots = None if values is None else values[chosen]
        if spots is not None and spots.ndim > 1:
            spots = spots[:, order]
            spots = np.concatenate([spots, (spots + spots[:, [1, 2, 0]]) / 2], axis=1)
        for pattern in _PATTERNS[bin(value).count("1")]:
            parts.append(six[:, pattern])
            carried.append(spots if spots is None or spots.ndim == 1 else spots[:, pattern])
    return np.concatenate(parts), None if values is None else np.concatenate(carried)
