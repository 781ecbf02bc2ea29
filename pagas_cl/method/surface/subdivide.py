"""Splitting edges of a triangle mesh in the middle, without cracks, carrying everything that sits on it.

The surface stays the same set of points; original vertices keep their places and come first. Vertices at one place, as
seams have them, are one: both sides of a seam are split alike. What sits on vertices, corners (texture coordinates with
seams) or faces is carried along by the `Subdivision`."""

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.method.surface.weld import welded

_ROUNDS = 24
_MOST_VERTICES = 40_000_000  # 3 GB of positions and faces
# corners of the new triangles where edges 01; 01 and 12; all three are split: 0 1 2 corners, 3 4 5 middles of 01 12 20
_PATTERNS = {1: ((0, 3, 2), (3, 1, 2)), 2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
             3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}
# which edges are split (bits 1 2 4) -> how often to rotate the face so that one of the patterns fits
_ROTATIONS = {1: 0, 2: 1, 4: 2, 3: 0, 6: 1, 5: 2, 7: 0}
_MADE_OF = np.array([1 + code.bit_count() for code in range(8)], np.int32)      # faces, by the same bits
# edges between these corners and middles are whole sides, their first halves, their second ones; others are new
_KNOWN = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 4), (2, 5), (1, 3), (2, 4), (0, 5))


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
    a, b = (np.take(values, end, axis=0) for end in pairs.T)       # of rows a third of the time of values[end]
    if values.dtype.kind != "f":
        return np.concatenate([values, a])
    with np.errstate(invalid="ignore"):
        b -= a
        b /= 2
        b += a
    return np.concatenate([values, np.where(np.isinf(a), a, b)])


def spread(longest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The least of `longest` (V,) among corners of the faces around each vertex: faces are split as a whole."""
    around, least = longest.copy(), np.take(longest, faces.T).min(axis=0)
    for corner in faces.T:              # all three at once take twice as long
        np.minimum.at(around, corner, least)
    return around


def subdivide(vertices: np.ndarray, faces: np.ndarray, longest: np.ndarray, *,
              most: int = _MOST_VERTICES) -> Subdivision:
    """Split every edge that is longer than `longest` at both ends, until none is. `longest` (V,) is the longest edge
    wanted at each vertex of `vertices` (V, 3), and around it (see spread); infinite leaves edges alone. InputError
    where more than `most` vertices would be needed."""
    mesh, fresh = Splitting(np.asarray(vertices, np.float64), np.asarray(faces, np.int32), longest), slice(None)
    for _ in range(_ROUNDS):
        chosen = mesh.edges.longer(mesh.points, mesh.unit, fresh)
        if not len(chosen):
            return mesh.division()
        if len(mesh.place) + len(chosen) > most:
            raise InputError(f"subdividing to the pixel footprint needs more than {most} vertices; use a coarser "
                             "target (--subdivide with more footprints), or none")
        fresh = mesh.split(chosen)
    raise InputError("subdividing did not end: the mesh has edges of very different lengths; remesh it first")


class Splitting:
    """A mesh while it is split: `points` (W, 3) are its places, `start` (W, 3) where they came from, None where that is
    as they were given; `place` (V,) is that of each vertex, `unit` (W,) a length at each place and around it (see
    spread); `edges` are between places, `own` between vertices, the same ones where no two vertices are at one
    place."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, unit: np.ndarray):
        self.points, self.place = welded(vertices)
        self.start: np.ndarray | None = None
        self.unit = np.full(len(self.points), np.inf)
        np.minimum.at(self.unit, self.place, unit)
        self.unit = spread(self.unit, self.place[faces])
        self.given = faces
        self.own = self.edges = Edges(faces, len(vertices))
        if len(self.points) < len(self.place):
            self.edges = Edges(self.place[faces], len(self.points))
        self.count = len(vertices)
        self.rounds: list[np.ndarray] = []

    def division(self) -> Subdivision:
        return Subdivision(self.count, self.given, self.own.faces, self.own.table[6], self.rounds)

    def split(self, chosen: np.ndarray) -> np.ndarray:
        """Split the edges of these numbers, sorted by their ends; as Edges.split_at."""
        pairs, own = self.edges.ends[chosen], chosen
        place = np.full(len(self.edges.ends), -1, np.int32)
        place[chosen] = len(self.points) + np.arange(len(chosen), dtype=np.int32)
        if self.own is not self.edges:
            place_of = np.empty(len(self.own.ends), np.int32)
            place_of[self.own.sides] = place[self.edges.sides]
            own = self.own.in_order(np.flatnonzero(place_of >= 0))
            self.place = np.append(self.place, place_of[own])
            self.rounds.append(self.own.ends[own])
            self.own.split_at(own)
        else:
            self.place = np.append(self.place, place[chosen])
            self.rounds.append(pairs)
        self.points = with_middles(self.points, pairs)
        self.start = None if self.start is None else with_middles(self.start, pairs)
        self.unit = np.append(self.unit, np.minimum(*self.unit[pairs.T]))
        return self.edges.split_at(chosen)


class Edges:
    """Faces of a mesh of `count` vertices, corners in rows 0 to 2 of `table` (7, F), the numbers of their edges 01, 12,
    20 in rows 3 to 5, that of the face it was made of in the last; the ends (E, 2) of the edges, the lesser first; all
    int32. At first edges are in the order of their ends; nothing is sorted again while they are split."""

    def __init__(self, faces: np.ndarray, count: int):
        corners = np.ascontiguousarray(faces.T, np.int32)
        key = keys(corners, corners[[1, 2, 0]], count).reshape(-1)
        order = np.argsort(key)
        key = key[order]
        fresh = np.append(True, key[1:] != key[:-1])
        sides = np.empty(len(key), np.int32)
        sides[order] = np.cumsum(fresh, dtype=np.int32) - 1
        self.count = count
        self.table = np.vstack([corners, sides.reshape(3, -1), np.arange(len(faces), dtype=np.int32)])
        self.ends = np.stack(np.divmod(key[fresh], count), axis=1).astype(np.int32)

    @property
    def sides(self) -> np.ndarray:
        """(3, F)"""
        return self.table[3:6]

    @property
    def faces(self) -> np.ndarray:
        """(F, 3), a copy."""
        return np.ascontiguousarray(self.table[:3].T)

    def __len__(self) -> int:
        """How many faces there are."""
        return self.table.shape[1]

    def in_order(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers of edges, sorted by their ends."""
        return numbers[np.argsort(keys(*self.ends[numbers].T, self.count))]

    def of_pairs(self, pairs: np.ndarray) -> np.ndarray:
        """Which of the `pairs` of vertices (N, 2), sorted, the lesser first, each edge joins: (E,), -1 = none."""
        if not len(pairs):
            return np.full(len(self.ends), -1)
        wanted, own = keys(*pairs.T, self.count), keys(*self.ends.T, self.count)
        at = np.minimum(np.searchsorted(wanted, own), len(wanted) - 1)
        return np.where(wanted[at] == own, at, -1)

    def longer(self, points: np.ndarray, longest: np.ndarray,
               among: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Numbers of the edges `among` these that are longer than `longest` (V,) at both ends, sorted by their ends."""
        a, b = self.ends[among].T
        long = self.lengths(points, among) > np.maximum(longest[a], longest[b])
        return self.in_order(np.arange(len(self.ends), dtype=np.int32)[among][long])

    def lengths(self, points: np.ndarray, among: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Of the edges `among` these, float64 (N,), their vertices at `points` (V, 3)."""
        a, b = self.ends[among].T
        total = np.zeros(len(a))
        for column in np.ascontiguousarray(points.T):       # a half of the memory and of the time of whole rows
            apart = column[a]
            apart -= column[b]
            apart *= apart
            total += apart
        return np.sqrt(total, out=total)

    def split_at(self, chosen: np.ndarray) -> np.ndarray:
        """Split the edges of these numbers, the first by the first new vertex; numbers of edges new or shorter."""
        before, rank = len(self.ends), np.full(len(self.ends), -1, np.int32)
        rank[chosen] = np.arange(len(chosen), dtype=np.int32)
        self.split(rank, len(chosen))
        return np.append(chosen, np.arange(before, len(self.ends), dtype=np.int32))

    def split(self, rank: np.ndarray, number: int, values: np.ndarray | None = None) -> np.ndarray | None:
        """Put `number` new vertices on the edges, by their `rank` (E,), -1 = none: faces that have some become two,
        three or four, next to one another: what lies together in space stays so in memory. With them go `values` on
        their corners (F, 3, C), which are given back."""
        middle = np.where(rank < 0, -1, rank + self.count).astype(np.int32)
        chosen, is_cut = np.flatnonzero(rank >= 0), (rank >= 0).view(np.uint8)
        upper = np.zeros(len(middle), np.int32)                    # the half of a split edge at its greater end
        upper[chosen] = np.arange(len(middle), len(middle) + len(chosen))
        code = is_cut[self.sides[0]]
        code |= is_cut[self.sides[1]] << 1
        code |= is_cut[self.sides[2]] << 2
        first_of = np.cumsum(np.append(np.int32(0), _MADE_OF[code]), dtype=np.int32)
        ends, total = [_pair(self.ends[chosen, 1], middle[chosen])], len(middle) + len(chosen)
        table, whole = np.empty((7, first_of[-1]), np.int32), np.flatnonzero(code == 0)
        at, carried = first_of[whole], None
        for row, old in zip(table, self.table):
            row[at] = old[whole]
        if values is not None:
            carried = np.empty((len(table[0]), *values.shape[1:]), values.dtype)
            carried[at] = values[whole]
        for value, rotation in _ROTATIONS.items():
            rows = np.flatnonzero(code == value)
            if not len(rows):
                continue
            order = [(side + rotation) % 3 for side in range(3)]
            corner, side = ([self.table[first + k][rows] for k in order] for first in (0, 3))
            first, second = [], []
            for k in range(3):
                low, other = self.ends[side[k], 0] == corner[k], upper[side[k]]
                first.append(np.where(low, side[k], other))
                second.append(np.where(low, other, side[k]))
            places, known = corner + [middle[part] for part in side], dict(zip(_KNOWN, side + first + second))
            spots = None if values is None else values[rows]
            if spots is not None:
                spots = spots[:, order]
                spots = np.concatenate([spots, (spots + spots[:, [1, 2, 0]]) / 2], axis=1)
            for place, pattern in enumerate(_PATTERNS[value.bit_count()]):
                at, around = first_of[rows] + place, [tuple(sorted((pattern[k], pattern[k - 2]))) for k in range(3)]
                for pair in (pair for pair in around if pair not in known):
                    known[pair] = np.arange(total, total + len(rows), dtype=np.int32)
                    total += len(rows)
                    ends.append(_pair(*(places[k] for k in pair)))
                for k in range(3):
                    table[k, at], table[3 + k, at] = places[pattern[k]], known[around[k]]
                table[6, at] = self.table[6][rows]
                if carried is not None:
                    carried[at] = spots[:, pattern]
        self.ends[chosen, 1] = middle[chosen]
        self.ends, self.table, self.count = np.concatenate([self.ends, *ends]), table, self.count + number
        return carried


def keys(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """One int64 for each pair of vertices below `count`, in the order of the lesser, then of the greater."""
    key: np.ndarray = np.minimum(a, b).astype(np.int64)
    key *= count
    key += np.maximum(a, b)
    return key


def _pair(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1)
