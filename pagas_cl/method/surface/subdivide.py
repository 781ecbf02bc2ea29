"""Splitting edges of a triangle mesh in the middle, without cracks, carrying everything that sits on it.

The surface stays the same set of points; original vertices keep their places and come first. What sits on vertices,
corners (texture coordinates with seams) or faces is carried along by the `Subdivision`. Vertices at one place, as
seams have them, are one for what is split and what is kept (`place`), so that seams do not open.
"""

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.method.surface.edges import Edges

_ROUNDS = 24
_MOST_VERTICES = 40_000_000  # 3 GB of positions and faces


@dataclass(frozen=True, eq=False)
class Subdivision:
    """How a mesh of `count` vertices was subdivided: its faces (F, 3) before and (F', 3) after, and of which each was
    made (F',), int32; for each round the pairs (E, 2) of vertices between which new ones were put, in their order."""

    count: int
    given: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    parents: np.ndarray = field(repr=False)
    rounds: list[np.ndarray] = field(repr=False)

    def vertices(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (V, ...) on the new vertices: the mean of the two ends; of whole numbers, the first."""
        for pairs in self.rounds:
            values = with_middles(values, pairs)
        return values

    def corners(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, 3, C), one a corner, on the corners of the new faces."""
        edges, carried = Edges(self.given, self.count), values.astype(np.float64)
        for pairs in self.rounds:
            carried = edges.split(edges.of_pairs(pairs), len(pairs), carried)
        return carried.astype(values.dtype)

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        """Values of shape (F, ...) on the new faces: the parent's."""
        return values[self.parents]


def with_middles(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Values (V, ...) of vertices, and after them those in the middles of `pairs` (E, 2); of whole numbers, the
    first's. The middle of what is infinite, as a deviation where nothing is known, is infinite, and no warning."""
    a, b = values[pairs[:, 0]], values[pairs[:, 1]]
    middle = a
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            middle = np.where(np.isinf(a), a, a + (b - a) / 2)
    return np.concatenate([values, middle.astype(values.dtype)])


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
    edges, longest, fresh = Edges(given, count), spread(longest, given), slice(None)
    for _ in range(_ROUNDS):
        chosen = edges.longer(vertices, longest, fresh)
        if not len(chosen):
            return Subdivision(count, given, edges.faces, edges.table[6], rounds)
        if len(vertices) + len(chosen) > most:
            raise InputError(f"subdividing to the pixel footprint needs more than {most} vertices; use a coarser "
                             "target (--subdivide with more footprints), or none")
        rounds.append(edges.ends[chosen])
        fresh = edges.split_at(chosen)
        vertices = with_middles(vertices, rounds[-1])
        longest = np.append(longest, np.minimum(*longest[rounds[-1].T]))
    raise InputError("subdividing did not end: the mesh has edges of very different lengths; remesh it first")
