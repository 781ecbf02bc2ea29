"""Triangles that cross others, turned over or have no area, found on a device and undone (method section 10.5): where a
mesh had none before it was moved, vertices are displaced as their neighbours are instead, or less far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.method.surface.raster import Frame, frame_of, in_frame
from pagas_cl.method.surface.subdivide import Subdivision
from pagas_cl.method.surface.weld import at_a_corner, connected_components, in_order_of, unlike, welded
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.scene.mesh import Surface

TURNED, FLAT, CROSSING, FOLDED = 1, 2, 4, 8     # the last two: crosses another component of the mesh, its own
_BRANCHES = 8              # of the tree that crossing ones are looked for in, as in the kernel
_CODE_BITS = 60            # of a code, as in the kernel; the last ones order nothing
_DOING = "looking for triangles that cross"
# Constants of section 10.5.
_RING_PASSES = 3           # times that displacements of new faults become the mean of their neighbours',
_MOST_RINGS = 4            # then with a ring of vertices more around them, up to so many
_RINGS = 6                 # around new faults that are looked at meanwhile
_TRIES = (False, True, True, True)      # whether displacements are halved instead, one try after the other


def faults(device: Device, before: np.ndarray, after: np.ndarray, faces: np.ndarray, component: np.ndarray,
           frame: Frame) -> np.ndarray:
    """FaultSearch.run, once."""
    search = FaultSearch(device, before, faces, component, frame)
    found = search.run(after)
    search.release()
    return found


class FaultSearch:
    """The `faces` (F, 3) of a mesh on a device, whose vertices (V, 3), one at a place, move away from `before`, to be
    looked at as often as they move. `component` (V,) int32: their connected component of the mesh. `frame`: what
    places are taken in (raster.frame_of). Triangles keep the order of their places before: where they are by then, the
    boxes of the tree say."""

    def __init__(self, device: Device, before: np.ndarray, faces: np.ndarray, component: np.ndarray, frame: Frame):
        self.device, self.faces, self.frame = device, faces, frame
        self._count, count, self._first = len(before), len(faces), _levels(len(faces))
        if not count:
            return
        with translate_cl_errors(device, _DOING):
            self._program = build(device, "mesh_faults.cl")
            self._known = {"before": upload(device, in_frame(before, frame)),
                           "faces": upload(device, np.ascontiguousarray(faces, np.int32)),
                           "part": upload(device, component), "first": upload(device, self._first[:-1])}
            for name, size in (("codes", 8 * count), ("wrong", count), ("crossing", 4 * count),
                               ("boxes", 24 * int(self._first[-1]))):
                self._known[name] = device.memory.buffer(device.context, size, name)
            self._run("find_codes", count)
            codes = download(device, self._known["codes"], count, np.uint64)
            self._known["order"] = upload(device, in_order_of(codes >> np.uint64(_CODE_BITS - 32), np.arange(count)))
            self._known.pop("codes").release()

    def run(self, after: np.ndarray) -> np.ndarray:
        """What is wrong with each face where its vertices are `after` (V, 3): int32 (F,), the sum of TURNED, FLAT,
        CROSSING and FOLDED."""
        device, count = self.device, len(self.faces)
        if not count:
            return np.zeros(0, np.int32)
        with translate_cl_errors(device, _DOING):
            positions = upload(device, in_frame(after, self.frame))
            cl.enqueue_fill_buffer(device.queue, self._known["crossing"], np.int32(0), 0, 4 * count)
            self._run("find_boxes", count, positions=positions)
            for level, number in enumerate(np.diff(self._first)[1:].tolist(), start=1):
                self._run("join_boxes", number, level=level, count=number)
            self._run("find_crossing", count, positions=positions)
            found = download(device, self._known["crossing"], count, np.int32)
            found |= download(device, self._known["wrong"], count, np.uint8)
            positions.release()
        return found

    def around(self, wrong: np.ndarray, rings: int) -> np.ndarray:
        """Which vertices are corners of the faces that are `wrong` (F,) bool, or lie so many rings around them: bool
        (V,)."""
        marked = np.zeros(self._count, np.uint8)
        marked[self.faces[wrong]] = 1
        if not rings:
            return marked.view(bool)
        with translate_cl_errors(self.device, _DOING):
            marks, wider = upload(self.device, marked), upload(self.device, marked)
            for _ in range(rings):
                cl.enqueue_copy(self.device.queue, wider, marks)
                self._run("widen", len(self.faces), marked=marks, wider=wider)
                marks, wider = wider, marks
            found = download(self.device, marks, self._count, np.uint8)
            marks.release()
            wider.release()
        return found.view(bool)

    def _run(self, name: str, items: int, **more: Any) -> None:
        known = {"count": len(self.faces), **self._known, **more}
        run_once(self.device.queue, [bind(self._program, name, (items,), None, known)])

    def release(self) -> None:
        """Give the buffers back."""
        if len(self.faces):
            for buffer in self._known.values():
                buffer.release()


def _levels(count: int) -> np.ndarray:
    """Where the boxes of each level of the tree above `count` triangles begin, int32, and how many there are in all."""
    sizes = [count]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // _BRANCHES))
    return np.cumsum([0, *sizes], dtype=np.int32)


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
                start: np.ndarray | None = None, place: np.ndarray | None = None) -> tuple[np.ndarray, Faults]:
    """Where the vertices (V', 3) of a mesh, split as `division` says, are to be so that it has no fault that `given`
    had not: the corners of such triangles are displaced as their neighbours are, from where they were given or from
    `start` (V', 3). Where the given mesh, split alike, has faults, triangles around them are let alone, and so are
    components that stood in others. And how many have faults, as a sentence. `place` (V',): which vertices are at one
    place, by numbers from 0; found where it is not given."""
    before, faces = given.vertices, given.faces
    if division is not None:
        before, faces = division.vertices(before), division.faces
    place = welded(before)[1] if place is None else place
    count = int(place.max()) + 1
    one = np.empty(count, np.int64)                        # a vertex at each place: those at one place stay together
    one[place] = np.arange(len(place))
    before, end = before[one], vertices[one]
    start = before if start is None else start[one]
    given_faces, faces = place[given.faces], place[faces]
    frame = frame_of(Surface(start, faces))      # one for all: what is rounded is rounded alike each time
    first = place[:len(given.vertices)]
    own = connected_components(given_faces, int(first.max()) + 1)[first].astype(np.int32)
    component = (own if division is None else division.vertices(own))[one]
    old = faults(device, before, before, given_faces, component, frame)
    tolerated = _near_old(device, before, given, faces, division, component, old, frame)
    stands_in = np.zeros(count, bool)                      # components that stood in others
    stands_in[own[given.faces[(old & CROSSING) > 0, 0]]] = True
    tolerated |= np.where(stands_in[component[faces[:, 0]]], CROSSING, 0)
    search = FaultSearch(device, start, faces, component, frame)
    now, found = end, search.run(end)
    if start is not before and (found & ~tolerated).any():
        tolerated |= search.run(start)
    for halved in _TRIES:
        new = found & ~tolerated
        if not new.any():
            break
        some = np.flatnonzero(search.around(new > 0, _RINGS)[faces[:, 0]])
        here, corners = _compact(count, faces[some])
        tolerated[some] |= faults(device, before[here], before[here], corners, component[here], frame)
        now = now.copy()
        now[here] = _mended(device, start[here], now[here], corners, component[here], found[some], tolerated[some],
                            frame, halved)
        found = search.run(now)
    search.release()
    mended = unlike(now, end)
    crossing = CROSSING | FOLDED
    return np.where(mended[place][:, None], now[place], vertices), Faults(
        given=len(old), crossed=_count(old, crossing), had_no_area=_count(old, FLAT), count=len(found),
        crossing=_count(found, crossing), no_area=_count(found, FLAT), turned=_count(found, TURNED),
        new=_count(found & ~tolerated, crossing), mended=int(mended.sum()))


def _near_old(device: Device, start: np.ndarray, given: Surface, faces: np.ndarray,
              division: Subdivision | None, component: np.ndarray, old: np.ndarray, frame: Frame) -> np.ndarray:
    """Faults (F',) that the faces may have since they, split alike, or faces around them had them at `start`."""
    wrong = np.zeros(len(given.vertices), bool)
    wrong[given.faces[(old & ~CROSSING) > 0]] = True
    there = at_a_corner(wrong, given.faces)
    some = np.flatnonzero(there if division is None else there[division.parents])
    near, corners = faces[some], np.zeros(len(start), bool)
    corners[near[(faults(device, start, start, near, component, frame) & ~CROSSING) > 0]] = True
    if not corners.any():
        return np.zeros(len(faces), np.int32)
    corners[faces[at_a_corner(corners, faces)]] = True      # and a ring around them
    return np.where(at_a_corner(corners, faces), np.int32(~CROSSING), np.int32(0))


def _compact(count: int, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` vertices the `faces` have, and the faces by their numbers among these, int32."""
    used = np.zeros(count, bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32)
    number -= 1
    return np.flatnonzero(used), number[faces]


def _mended(device: Device, start: np.ndarray, now: np.ndarray, faces: np.ndarray, component: np.ndarray,
            found: np.ndarray, tolerated: np.ndarray, frame: Frame, halved: bool) -> np.ndarray:
    """Places of vertices at `now`, moved until no face has a fault that is not `tolerated`: around `found` ones,
    farther and farther, displacements from `start` become the means of their neighbours' or are `halved`."""
    mended, part = now.copy(), np.arange(len(now))
    for rings in range(_MOST_RINGS + 1):
        search = FaultSearch(device, start, faces, component, frame)
        for _ in range(_RING_PASSES):
            marked = search.around((found & ~tolerated) > 0, rings)
            if halved:
                now = np.where(marked[:, None], start + (now - start) / 2, now)
            else:
                now = _smoothed(start, now, faces, marked, rings + 1)
            found = search.run(now)
            if not (found & ~tolerated).any():
                break
        mended[part] = now
        near = search.around((found & ~tolerated) > 0, _RINGS)[faces[:, 0]]
        search.release()
        if not near.any():
            break
        here, faces = _compact(len(now), faces[near])
        start, now, component, part = start[here], now[here], component[here], part[here]
        found, tolerated = found[near], tolerated[near]
    return mended


def _smoothed(start: np.ndarray, now: np.ndarray, faces: np.ndarray, marked: np.ndarray, times: int) -> np.ndarray:
    """Places `now`, displacements from `start` the mean of their neighbours', so many times, where `marked` (V,)."""
    here, corners = _compact(len(now), faces[at_a_corner(marked, faces)])
    inner, now = marked[here], now.copy()
    displacements = now[here] - start[here]
    for _ in range(times):
        displacements = np.where(inner[:, None], _neighbours_mean(displacements, corners), displacements)
    now[here[inner]] = start[here[inner]] + displacements[inner]
    return now


def _neighbours_mean(displacements: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The mean over the other corners of a vertex's faces, of all vertices (V, 3)."""
    count = len(displacements)
    total, number = np.zeros(displacements.shape), np.zeros(count)
    for side in range(3):
        corner, second, third = (faces[:, side - k] for k in range(3))
        number += 2 * np.bincount(corner, minlength=count)
        for along, values in zip(total.T, displacements.T):
            along += np.bincount(corner, values[second] + values[third], count)
    return total / number[:, None]


def _count(found: np.ndarray, fault: int) -> int:
    return int(np.count_nonzero(found & fault))
