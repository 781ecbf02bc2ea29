"""Triangles that cross others, turned over or have no area, found on a device (method section 10.5)."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from pagas_cl.method.surface.raster import Frame, in_frame
from pagas_cl.method.surface.weld import at_a_corner, unlike
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import bind, build, run_once

TURNED, FLAT, CROSSING, FOLDED = 1, 2, 4, 8     # the last two: crosses another component of the mesh, its own
_BRANCHES = 8              # of the tree that crossing ones are looked for in, as in the kernel
_CODE_BITS = 60            # of a code, as in the kernel; the last ones order nothing
_DOING = "looking for triangles that cross"
Last: TypeAlias = tuple[np.ndarray, np.ndarray]   # places of vertices, and what was found there


def faults(device: Device, before: np.ndarray, after: np.ndarray, faces: np.ndarray, component: np.ndarray,
           frame: Frame, last: Last | None = None) -> np.ndarray:
    """FaultSearch.run, once."""
    search = FaultSearch(device, before, faces, component, frame)
    found = search.run(after, last)
    search.release()
    return found


class FaultSearch:
    """The `faces` (F, 3) of a mesh on a device, whose vertices (V, 3), one at a place, move away from `before`, to be
    looked at as often as they move. `component` (V,) int32: their connected component of the mesh. `frame`: what
    places are taken in (raster.frame_of). Triangles keep the order of their places before: where they are by then, the
    boxes of the tree say."""

    def __init__(self, device: Device, before: np.ndarray, faces: np.ndarray, component: np.ndarray, frame: Frame):
        self.device, self.faces, self.frame = device, faces, frame
        count, self._first = len(faces), _levels(len(faces))
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
            self._order = np.argsort(codes >> np.uint64(_CODE_BITS - 32), kind="stable").astype(np.int32)
            self._known.pop("codes").release()

    def run(self, after: np.ndarray, last: Last | None = None) -> np.ndarray:
        """What is wrong with each face where its vertices are `after` (V, 3): int32 (F,), the sum of TURNED, FLAT,
        CROSSING and FOLDED. `last`: places of the vertices and what was found, the last time: pairs that did not move
        since and were without fault are not tested again."""
        device, count = self.device, len(self.faces)
        if not count:
            return np.zeros(0, np.int32)
        order, moved = self._order, count
        if last is not None:
            watched = _watched(after, self.faces, last)[order]
            order, moved = np.concatenate([order[watched], order[~watched]]), int(np.count_nonzero(watched))
        with translate_cl_errors(device, _DOING):
            own = {"positions": upload(device, in_frame(after, self.frame)), "order": upload(device, order)}
            cl.enqueue_fill_buffer(device.queue, self._known["crossing"], np.int32(0), 0, 4 * count)
            self._run("find_wrong", count, **own)
            if moved:
                self._run("find_boxes", count, **own)
                for level, number in enumerate(np.diff(self._first)[1:].tolist(), start=1):
                    self._run("join_boxes", number, level=level, count=number)
                self._run("find_crossing", moved, watched=moved, **own)
            found = download(device, self._known["crossing"], count, np.int32)
            found |= download(device, self._known["wrong"], count, np.uint8)
            for buffer in own.values():
                buffer.release()
        return found

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


def _watched(places: np.ndarray, faces: np.ndarray, last: Last) -> np.ndarray:
    """Which faces (F,) may cross others, their vertices at `places`, since the `last` time."""
    before, found = last
    return at_a_corner(unlike(before, places), faces) | (found & (CROSSING | FOLDED) > 0)
