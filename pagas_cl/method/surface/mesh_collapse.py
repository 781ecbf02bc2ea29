"""Fewer triangles: edges of a mesh collapsed, least costs first (method section 10.4).

What a collapse costs are quadrics (Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH
1997). One end of the edge is left, with all that sits on it, and moves to where its quadric is least."""

from dataclasses import dataclass, field

import numpy as np
import pyopencl as cl

from pagas_cl.method.surface.mesh_rings import grouped
from pagas_cl.method.surface.raster import frame_of
from pagas_cl.method.surface.subdivide import Subdivision
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.mesh import Surface

_SHARE = 0.4            # of the vertices that could collapse, those that cost least, of which some do in a round
_LIMITED = 4            # rounds in which the same ones may
_REBUILT = 0.7          # share of the triangles that are left when lists of those around vertices are made anew
_FREE, _PINNED, _KEPT = 0, 1, 2     # state of a vertex, as in the kernel
_ANY = 1e30             # a mean squared distance that is no limit


@dataclass(frozen=True, eq=False)
class Collapsed:
    """What is left of a Subdivision: `keep` (V'',), its vertices in their order; `faces` (F'', 3) of these; of which
    given face each was made, `parents` (F'',); and `corner` (F'', 3), which of the corners of the Subdivision's faces,
    counted by rows, each corner is like."""

    division: Subdivision = field(repr=False)
    keep: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    parents: np.ndarray = field(repr=False)
    corner: np.ndarray = field(repr=False)

    def vertices(self, values: np.ndarray) -> np.ndarray:
        return np.take(self.division.vertices(values), self.keep, axis=0)

    def corners(self, values: np.ndarray) -> np.ndarray:
        carried = self.division.corners(values)
        return carried.reshape(-1, carried.shape[-1])[self.corner]

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        return values[self.parents]


def simplified(device: Device, division: Subdivision, vertices: np.ndarray, unit: np.ndarray, place: np.ndarray,
               kept: np.ndarray, *, exact: bool, triangles: int = 0,
               tolerance: float = np.inf) -> tuple[Collapsed, np.ndarray]:
    """A mesh split as `division` says, its `vertices` (V', 3), with fewer triangles: as collapse says. And where the
    vertices are that are left, (V'', 3).

    `unit` (V',) is the footprint at each vertex, infinite where no view sees it; vertices with the same `place` (V',)
    stay together; those that are `kept` (V',) bool stay. `exact`: what is made of a given triangle stays within its
    sides, its corners stay, and no vertex moves, so that all that sits on it is where it was."""
    faces = division.faces
    corner_of, wedges = np.arange(3 * len(faces)), np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    if exact:
        _, corner_of, wedges = np.unique(faces * np.int64(len(division.given)) + division.parents[:, None],
                                         return_index=True, return_inverse=True)
        wedges = wedges.reshape(-1, 3)
    else:
        first = np.zeros(len(vertices), np.int32)
        first[faces] = wedges       # of the corners of a vertex, any
        wedges = first[faces]
    count = int(place.max()) + 1
    points, units = np.empty((count, 3)), np.empty(count)
    state = np.full(count, _PINNED if exact else _FREE, np.uint8)
    seen = np.isfinite(unit)
    points[place], units[place] = vertices, np.where(seen, unit, np.median(unit[seen]) if seen.any() else 1.0)
    at = place[faces]
    whole = (at[:, 0] != at[:, 1]) & (at[:, 1] != at[:, 2]) & (at[:, 2] != at[:, 0])
    state[place[kept]] = _KEPT
    if exact:
        state[place[:division.count]] = _KEPT
    state[at[~whole]] = _KEPT
    frame = frame_of(Surface(points, at))
    start = frame.local(points)
    left, there = np.flatnonzero(whole), ~whole
    some, wedges_left, moved = collapse(device, start, units / frame.unit, np.compress(whole, at, axis=0),
                                        np.compress(whole, wedges, axis=0), state,
                                        triangles=triangles - np.count_nonzero(there), tolerance=tolerance)
    left = left[some]
    wedges[left], there[left] = wedges_left, True
    corner = corner_of[np.compress(there, wedges, axis=0)]
    corners, used = faces.reshape(-1)[corner], np.ones(len(vertices), bool)
    used[faces] = False             # vertices without a triangle stay
    used[corners] = True
    new, keep = (np.cumsum(used) - 1).astype(np.int32), np.flatnonzero(used)
    own = place[keep]
    return (Collapsed(division, keep, new[corners], division.parents[there], corner),
            np.take(vertices, keep, axis=0) + frame.unit * (moved[own] - start[own]).astype(np.float64))


def collapse(device: Device, positions: np.ndarray, unit: np.ndarray, faces: np.ndarray, wedges: np.ndarray,
             state: np.ndarray, *, triangles: int = 0,
             tolerance: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Collapse edges until there are `triangles` left, or nothing that is left to do stays within `tolerance`
    footprints (root mean square). `positions` (V, 3) float32, `unit` (V,) the footprint there, in the same unit;
    corners of `faces` (F, 3) that are alike share a number in `wedges` (F, 3); `state` (V,) uint8 says which vertices
    stay. Gives which faces are left, their wedges (F'', 3), and the positions, of which some moved."""
    with translate_cl_errors(device, "simplifying the mesh"):
        work = _Collapsing(device, positions, unit, faces, wedges, state)
        while work.count > triangles and work.run(triangles, tolerance**2):
            pass
        _, wedges = work.listed_faces()
        positions = download(device, work.known["positions"], positions.shape)
        work.release()
    return work.numbers, wedges, positions


class _Collapsing:
    """A mesh on a device of which edges collapse; `count` triangles are left."""

    def __init__(self, device: Device, positions: np.ndarray, unit: np.ndarray, faces: np.ndarray, wedges: np.ndarray,
                 state: np.ndarray):
        self.device, self.vertices, self.count, self.rounds = device, len(positions), len(faces), 0
        self.program = build(device, "mesh_collapse.cl")
        self._limit, self._rounds_left = 0.0, 0      # of what a collapse may cost, and rounds until it is found anew
        self.numbers = np.arange(len(faces), dtype=np.int32)
        self.known = {"positions": upload(device, positions.astype(np.float32)),
                      "unit": upload(device, unit.astype(np.float32)),
                      "state": upload(device, state.astype(np.uint8)),
                      "target": upload(device, np.full(self.vertices, -1, np.int32))}
        for name, size in (("quadrics", 48), ("changed", 1), ("cost", 4), ("chosen", 1), ("received", 4)):
            self.known[name] = device.buffer(size * self.vertices, name)
        cl.enqueue_fill_buffer(device.queue, self.known["cost"], np.float32(np.inf), 0, 4 * self.vertices)
        cl.enqueue_fill_buffer(device.queue, self.known["changed"], np.uint8(1), 0, self.vertices)
        cl.enqueue_fill_buffer(device.queue, self.known["received"], np.int32(0), 0, 4 * self.vertices)
        self._list(faces, wedges)
        self._run("find_quadrics")

    def _run(self, name: str, **more: float) -> None:
        known = {**self.known, **more, "count": self.vertices}
        self.program.run(name, (self.vertices,), None, known)

    def _list(self, faces: np.ndarray, wedges: np.ndarray) -> None:
        """Lists of the faces around vertices, made anew."""
        self.listed = len(faces)
        for name in ("faces", "wedges", "next", "last", "first", "around"):
            if name in self.known:
                self.known.pop(name).release()
        for name, values in (("faces", faces), ("wedges", wedges), ("next", np.full(self.vertices, -1)),
                             ("last", np.arange(self.vertices))):
            self.known[name] = upload(self.device, values.astype(np.int32))
        self.known["first"], self.known["around"] = grouped(self.device, self.known["faces"], faces.size, self.vertices)

    def run(self, triangles: int, most: float) -> bool:
        """One round, down to `triangles`, within a mean squared distance `most`; whether there may be more to do."""
        self._run("choose", most=min(most, _ANY))
        cl.enqueue_fill_buffer(self.device.queue, self.known["changed"], np.uint8(0), 0, self.vertices)
        if not self._rounds_left:
            cost = self._costs()
            possible = cost[np.isfinite(cost)]
            if not len(possible):
                return False
            share = max(1, int(_SHARE * len(possible)))
            self._limit, self._rounds_left = float(np.partition(possible, share - 1)[share - 1]), _LIMITED
        self._rounds_left -= 1
        self._run("pick", limit=self._limit)
        chosen = download(self.device, self.known["chosen"], self.vertices, np.uint8)
        fewer = int(chosen.sum())
        if not fewer:
            self._rounds_left = 0
        if fewer > self.count - triangles:
            order, cost = np.flatnonzero(chosen), self._costs()
            order = order[np.argsort(cost[order], kind="stable")]
            enough = np.searchsorted(np.cumsum(chosen[order]), self.count - triangles) + 1
            chosen[order[enough:]] = 0
            self.known["chosen"].release()
            self.known["chosen"] = upload(self.device, chosen)
            fewer = int(chosen.sum())
        self.rounds += 1
        self._run("collapse", number=self.rounds)
        self._run("reposition", number=self.rounds)
        self.count -= fewer
        if self.count < _REBUILT * self.listed:
            self._list(*self.listed_faces())
        return True

    def _costs(self) -> np.ndarray:
        return download(self.device, self.known["cost"], self.vertices)

    def listed_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Those that are left, whose `numbers` follow, and their wedges."""
        faces, wedges = (download(self.device, self.known[name], (self.listed, 3), np.int32)
                         for name in ("faces", "wedges"))
        there = faces[:, 0] >= 0
        self.numbers = self.numbers[there]
        return np.compress(there, faces, axis=0), np.compress(there, wedges, axis=0)

    def release(self) -> None:
        release(*self.known.values())
