"""Triangles that cross others, turned over or have no area, found while vertices move on a device (method section
10.5)."""

from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.method.surface.raster import Frame
from pagas_cl.method.surface.weld import compact
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import Upload, build, run_once

TURNED, FLAT, CROSSING, FOLDED = 1, 2, 4, 8     # the last two: crosses another component of the mesh, its own
_BRANCHES = 8              # of the tree that crossing ones are looked for in, as in the kernel
_CODE_BITS = 60            # of a code, as in the kernel; the last ones order nothing


def faults(device: Device, before: np.ndarray, after: np.ndarray, faces: np.ndarray, component: np.ndarray,
           frame: Frame) -> np.ndarray:
    """What is wrong with each of the `faces` (F, 3): FaultSearch.run, once, of MovingVertices."""
    if not len(faces):
        return np.zeros(0, np.int32)
    here, corners = compact(len(before), faces)
    vertices = MovingVertices(device, np.take(before, here, axis=0), component[here], frame)
    order = vertices.in_order(corners)
    search, found = FaultSearch(vertices, np.take(corners, order, axis=0)), np.empty(len(faces), np.int32)
    found[order] = search.run(np.take(after, here, axis=0))
    release(search, vertices)
    return found


class MovingVertices:
    """Vertices (V, 3) of a mesh on a device, one at a place, that move away from `before`. `component` (V,) int32:
    their connected component of the mesh. `frame`: what places are taken in (raster.frame_of). `rings`: what is around
    them (mesh_rings.rings_of), needed where displacements are smoothed."""

    def __init__(self, device: Device, before: np.ndarray, component: np.ndarray, frame: Frame):
        self.device, self.frame, self.count, self.rings = device, frame, len(before), dict[str, cl.Buffer]()
        self._program = build(device, "mesh_faults.cl")
        self.known = {"before": upload(device, frame.local(before)), "part": upload(device, component)}
        for name, size in (("positions", 12 * self.count), ("after", 12 * self.count), ("marked", self.count),
                           ("wider", self.count), ("moved", self.count), ("number", 4)):
            self.known[name] = device.buffer(size, name)
        self.clear("moved")

    def in_order(self, faces: np.ndarray) -> np.ndarray:
        """The order (F,) in which faces (F, 3) come that were neighbours in space before anything moved."""
        count, device = len(faces), self.device
        own = {"faces": upload(device, np.ascontiguousarray(faces, np.int32)),
               "codes": device.buffer(8 * count, "codes")}
        self.run("find_codes", count, {**own, "count": count})
        codes = download(device, own["codes"], count, np.uint64)
        release(*own.values())
        codes >>= np.uint64(_CODE_BITS - 32)
        codes <<= np.uint64(32)
        codes |= np.arange(count, dtype=np.uint64)
        codes.sort()        # a fifth of the time of an argsort
        return (codes & np.uint64(0xFFFFFFFF)).astype(np.int32)

    def displace(self, times: int, halved: bool) -> None:
        """Displace marked vertices so many times by half as much, or as the mean of their neighbours is."""
        for _ in range(times):
            self.run("displace", self.count, {**self.rings, "count": self.count, "halved": halved})
            self.known["positions"], self.known["after"] = self.known["after"], self.known["positions"]

    def displaced(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which vertices were displaced (N,), and where they are (N, 3), as far from `start` (V, 3) as there."""
        some = np.flatnonzero(download(self.device, self.known["moved"], self.count, np.uint8))
        now, start = download(self.device, self.known["positions"], (self.count, 3))[some], start[some]
        return some, start + (now - self.frame.local(start)) * self.frame.unit

    def clear(self, name: str) -> None:
        cl.enqueue_fill_buffer(self.device.queue, self.known[name], np.uint8(0), 0, self.known[name].nbytes)

    def run(self, name: str, items: int, more: dict[str, Any]) -> None:
        self._program.run(name, (items,), None, {**self.known, **more})

    def release(self) -> None:
        release(*self.known.values(), *self.rings.values())


class FaultSearch:
    """Faces (F, 3) of vertices on a device, in_order, to be looked at as often as these move; `found` and `tolerated`
    (F,) where it is known what is wrong with them by now, and what may be. They keep their order: where they are by
    then, the boxes of the tree say."""

    def __init__(self, vertices: MovingVertices, faces: np.ndarray, found: np.ndarray | None = None,
                 tolerated: np.ndarray | None = None):
        self.vertices, self.faces, count, device = vertices, faces, len(faces), vertices.device
        self._first = _levels(count)
        self.known = {"faces": upload(device, faces), "first": upload(device, self._first[:-1])}
        for name, values in (("found", found), ("tolerated", tolerated)):
            self.known[name] = device.buffer(4 * count, name) if values is None else upload(device, values)
        boxes = int(self._first[-1])
        for name, size in (("active", count), ("boxes", 24 * boxes), ("hubs", max(4, 4 * (boxes - count)))):
            self.known[name] = device.buffer(size, name)

    def run(self, after: np.ndarray) -> np.ndarray:
        """What is wrong with each face, its vertices at `after` (V, 3): int32 (F,), sums of the four numbers above."""
        places = Upload(self.vertices.known["positions"], self.vertices.frame.local(after))
        run_once(self.vertices.device.queue, [places])
        self.look(again=False)
        return self.found()

    def look(self, again: bool = True, moved: str = "moved") -> None:
        """Look at all faces; `again`: at those that cross others, and those with vertices that have `moved`."""
        more = {"again": again, "moved": self.vertices.known[moved]}
        self._run("find_boxes", len(self.faces), **more)
        for level, number in enumerate(np.diff(self._first)[1:].tolist(), start=1):
            self._run("join_boxes", number, level=level, count=number)
        self._run("find_crossing", len(self.faces), **more)

    def found(self) -> np.ndarray:
        return download(self.vertices.device, self.known["found"], len(self.faces), np.int32)

    def tolerate(self, tolerated: np.ndarray) -> None:
        run_once(self.vertices.device.queue, [Upload(self.known["tolerated"], tolerated)])

    def mark(self, rings: int) -> int:
        """Mark corners of faces with faults that are not tolerated, and so many rings around; number of the faces."""
        self.vertices.clear("marked")
        self.vertices.clear("number")
        self._run("mark", len(self.faces))
        number = int(download(self.vertices.device, self.vertices.known["number"], 1, np.int32)[0])
        known = self.vertices.known
        for _ in range(rings if number else 0):
            cl.enqueue_copy(self.vertices.device.queue, known["wider"], known["marked"])
            self._run("widen", len(self.faces))
            known["marked"], known["wider"] = known["wider"], known["marked"]
        return number

    def around(self, rings: int) -> np.ndarray:
        """Numbers of the faces whose first corner `mark` marks."""
        if not self.mark(rings):
            return np.zeros(0, np.int64)
        marked = download(self.vertices.device, self.vertices.known["marked"], self.vertices.count, np.uint8)
        return np.flatnonzero(marked[self.faces[:, 0]])

    def _run(self, name: str, items: int, **more: Any) -> None:
        self.vertices.run(name, items, {"count": len(self.faces), **self.known, **more})

    def release(self) -> None:
        release(*self.known.values())


def _levels(count: int) -> np.ndarray:
    """Where the boxes of each level of the tree above `count` triangles begin, int32, and how many there are in all."""
    sizes = [count]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // _BRANCHES))
    return np.cumsum([0, *sizes], dtype=np.int32)
