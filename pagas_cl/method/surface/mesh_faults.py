"""Triangles that cross others, turned over or have no area, found on a device; where a mesh had none before it was
moved, vertices are displaced as their neighbours are instead (method section 10.5)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from pagas_cl.method.surface.components import connected_components
from pagas_cl.method.surface.raster import frame_of
from pagas_cl.method.surface.subdivide import Subdivision
from pagas_cl.method.surface.weld import at_a_corner, unlike, welded
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.scene.mesh import Surface

# Constants of section 10.5.
_PASSES = 15               # times that displacements of new faults become the mean of their neighbours'
_RING_PASSES = 3           # passes after which a ring of vertices more takes part
_RINGS = 6                 # around new faults that are looked at meanwhile
_TRIES = (False, True, True, True)      # whether displacements are halved instead, one try after the other
_BRANCHES = 8              # of the tree that crossing ones are looked for in, as in the kernel
_LAST = np.uint64(1 << 63)  # the bit of a code that puts a triangle after all those without
Frame: TypeAlias = tuple[np.ndarray, float]       # what frame_of gives
TURNED, FLAT, CROSSING, FOLDED = 1, 2, 4, 8     # the last two: crosses another component of the mesh, its own


@dataclass(frozen=True)
class Faults:
    """How many triangles there were and are, how many of them crossed others and had no area and how many do now, are
    turned over, cross others where none did; how many vertices were `mended` to avoid them."""

    given: int
    crossed: int
    had_no_area: int
    count: int
    crossing: int
    no_area: int
    turned: int
    new: int
    mended: int

    def then(self, later: Faults) -> Faults:
        """Of a mesh that was changed twice; between the two its triangles became fewer."""
        made = max(0, later.crossed - self.crossing)
        return replace(later, given=self.given, crossed=self.crossed, had_no_area=self.had_no_area,
                       new=self.new + later.new + made, mended=self.mended + later.mended)

    def __str__(self) -> str:
        return (f"{self.crossing} of {self.count} triangles cross others ({self.crossed} of {self.given} given ones did"
                f"), {self.new} of them where none did before; {self.turned} are turned over, {self.no_area} have no "
                f"area ({self.had_no_area} before); to avoid them {self.mended} vertices moved as their neighbours did"
                ", or less far")


def without_new(device: Device, given: Surface, division: Subdivision | None, vertices: np.ndarray,
                start: np.ndarray | None = None) -> tuple[np.ndarray, Faults]:
    """Where the vertices (V', 3) of a mesh, split as `division` says, are to be so that it has no fault that `given`
    had not: the corners of such triangles are displaced as their neighbours are, from where they were given or from
    `start` (V', 3). Where the given mesh, split alike, has faults, triangles around them are let alone, and so are
    components that stood in others. And how many have faults, as a sentence."""
    before, faces = given.vertices, given.faces
    if division is not None:
        before, faces = division.vertices(before), division.faces
    points, place = welded(before)
    one = np.empty(len(points), np.int64)                  # a vertex at each place: those at one place stay together
    one[place] = np.arange(len(place))
    before, end = before[one], vertices[one]
    start = before if start is None else start[one]
    given_faces, faces = place[given.faces], place[faces]
    frame = frame_of(Surface(start, faces))      # one for all: what is rounded is rounded alike each time
    own = connected_components(given_faces, len(points))[place[:len(given.vertices)]].astype(np.int32)
    component = (own if division is None else division.vertices(own))[one]
    old = faults(device, before, before, given_faces, component, frame)
    tolerated = _near_old(device, before, given.faces, faces, division, component, old, frame)
    stands_in = np.zeros(len(points), bool)                # components that stood in others
    stands_in[own[given.faces[(old & CROSSING) > 0, 0]]] = True
    tolerated |= np.where(stands_in[component[faces[:, 0]]], CROSSING, 0)
    now, found = end, faults(device, start, end, faces, component, frame)
    if start is not before and (found & ~tolerated).any():
        tolerated |= faults(device, start, start, faces, component, frame)
    for halved in _TRIES:
        new = found & ~tolerated
        if not new.any():
            break
        some = np.flatnonzero(_marked(faces, faces[new > 0], _RINGS)[faces[:, 0]])
        here, corners = np.unique(faces[some], return_inverse=True)
        corners = corners.reshape(-1, 3)
        tolerated[some] |= faults(device, before[here], before[here], corners, component[here], frame)
        last, now = (now, found), now.copy()
        now[here] = _mended(device, start[here], now[here], corners, component[here], found[some], tolerated[some],
                            frame, halved)
        found = faults(device, start, now, faces, component, frame, last)
    mended = unlike(now, end)
    crossing = CROSSING | FOLDED
    return np.where(mended[place][:, None], now[place], vertices), Faults(
        given=len(old), crossed=_count(old, crossing), had_no_area=_count(old, FLAT), count=len(found),
        crossing=_count(found, crossing), no_area=_count(found, FLAT), turned=_count(found, TURNED),
        new=_count(found & ~tolerated, crossing), mended=int(mended.sum()))


def _near_old(device: Device, start: np.ndarray, given_faces: np.ndarray, faces: np.ndarray,
              division: Subdivision | None, component: np.ndarray, old: np.ndarray, frame: Frame) -> np.ndarray:
    """Faults (F',) that the faces may have since they, split alike, or faces around them had them at `start`."""
    around = at_a_corner(_marked(given_faces, given_faces[(old & ~CROSSING) > 0], 0), given_faces)
    some = np.flatnonzero(around if division is None else around[division.parents])
    folded = some[(faults(device, start, start, faces[some], component, frame) & ~CROSSING) > 0]
    return np.where(at_a_corner(_marked(faces, faces[folded], 1), faces), ~CROSSING, 0)


def _marked(faces: np.ndarray, wrong: np.ndarray, rings: int) -> np.ndarray:
    """Which vertices are corners of the `wrong` faces, or lie so many rings around them: bool, up to the last one."""
    marked = np.zeros(int(faces.max()) + 1, bool)
    marked[wrong] = True
    for _ in range(rings):
        marked[faces[at_a_corner(marked, faces)]] = True
    return marked


def _mended(device: Device, start: np.ndarray, now: np.ndarray, faces: np.ndarray, component: np.ndarray,
            found: np.ndarray, tolerated: np.ndarray, frame: Frame, halved: bool) -> np.ndarray:
    """Places of vertices at `now`, moved until no face has a fault that is not `tolerated`: around `found` ones,
    farther and farther, displacements from `start` become the means of their neighbours' or are `halved`."""
    last = None         # what was found so far was found among more faces
    for number in range(_PASSES):
        rings = number // _RING_PASSES
        marked = _marked(faces, faces[(found & ~tolerated) > 0], rings)
        near = faces[at_a_corner(marked, faces)]
        for _ in range(1 if halved else rings + 1):
            displacements = (now - start) / 2 if halved else _neighbours_mean(now - start, near)
            now = np.where(marked[:, None], start + displacements, now)
        found = faults(device, start, now, faces, component, frame, last)
        last = now, found
        if not (found & ~tolerated).any():
            break
    return now


def _neighbours_mean(displacements: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The mean over the other corners of a vertex's faces, of all vertices (V, 3); 0 where it has no face."""
    count = len(displacements)
    total, number = np.zeros(displacements.shape), np.zeros(count)
    for side in range(3):
        corner, second, third = (faces[:, side - k] for k in range(3))
        number += 2 * np.bincount(corner, minlength=count)
        for along, values in zip(total.T, displacements.T):
            along += np.bincount(corner, values[second] + values[third], count)
    return total / np.maximum(number, 1)[:, None]


def _count(found: np.ndarray, fault: int) -> int:
    return int(np.count_nonzero(found & fault))


def faults(device: Device, before: np.ndarray, after: np.ndarray, faces: np.ndarray, component: np.ndarray,
           frame: Frame, last: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """What is wrong with each of the `faces` (F, 3) of a mesh whose vertices (V, 3), one at a place, went from `before`
    to `after`: int32 (F,), the sum of TURNED, FLAT, CROSSING and FOLDED. `component` (V,) int32: their connected
    component of the mesh. `frame`: what places are taken in (raster.frame_of). `last`: places of the vertices and what
    was found, the last time that these faces were looked at, in this frame: pairs that did not move since and were
    without fault are not tested again."""
    count = len(faces)
    if not count:
        return np.zeros(0, np.int32)
    middle, unit = frame
    watched = _watched(after, faces, last)
    first = _levels(count)
    with translate_cl_errors(device, "looking for triangles that cross"):
        program = build(device, "mesh_faults.cl")
        known = {"positions": upload(device, ((after - middle) / unit).astype(np.float32)),
                 "before": upload(device, ((before - middle) / unit).astype(np.float32)),
                 "faces": upload(device, np.ascontiguousarray(faces, np.int32)),
                 "codes": device.memory.buffer(device.context, 8 * count, "codes"),
                 "wrong": device.memory.buffer(device.context, count, "wrong"),
                 "first": upload(device, first[:-1]),
                 "boxes": device.memory.buffer(device.context, 24 * int(first[-1]), "boxes"),
                 "part": upload(device, component), "crossing": upload(device, np.zeros(count, np.int32))}
        run_once(device.queue, [bind(program, "find_codes", (count,), None, known, count=count)])
        codes = download(device, known["codes"], count, np.uint64)
        codes[~watched] |= _LAST
        known["order"] = upload(device, np.argsort(codes).astype(np.int32))
        run_once(device.queue, [bind(program, "find_boxes", (count,), None, known, count=count)])
        for level, number in enumerate(np.diff(first)[1:].tolist(), start=1):
            run_once(device.queue, [bind(program, "join_boxes", (number,), None, known, level=level, count=number)])
        moved = int(np.count_nonzero(watched))
        if moved:
            run_once(device.queue, [bind(program, "find_crossing", (moved,), None, known, watched=moved, count=count)])
        wrong = download(device, known["crossing"], count, np.int32) | download(device, known["wrong"], count, np.uint8)
        for buffer in known.values():
            buffer.release()
    return wrong


def _levels(count: int) -> np.ndarray:
    """Where the boxes of each level of the tree above `count` triangles begin, int32, and how many there are in all."""
    sizes = [count]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // _BRANCHES))
    return np.cumsum([0, *sizes], dtype=np.int32)


def _watched(places: np.ndarray, faces: np.ndarray, last: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """Which faces (F,) may cross others, their vertices at `places`: all where nothing is known of the `last` time."""
    if last is None:
        return np.ones(len(faces), bool)
    before, found = last
    return at_a_corner(unlike(before, places), faces) | (found & (CROSSING | FOLDED) > 0)
