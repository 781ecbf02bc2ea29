"""A mesh onto refined depth maps, coarse to fine, split where they show detail (method section 10.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pagas_cl.errors import log
from pagas_cl.scene.mesh import Surface
from pagas_cl.surface.mesh_evidence import Observed, Words, sent
from pagas_cl.surface.mesh_solve import OnDevice, Solved, orientation_of, solve_welded, welded, with_area
from pagas_cl.surface.subdivide import Subdivision, long_edges, split, spread, with_middles

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

COARSE, DETAIL = 6.0, 1.5   # footprints: edges to begin with, and the longest that are never split
_OFF = 2.0                  # times `flat` that the middle of an edge lies off, for which it is split
_LEVELS, _ROUNDS = 3, 2     # of splitting; of the solve after them
TRIANGLE_BYTES = 450        # of host and device memory together, at the peak (measured)
_FACE = 0.35                # area of a face whose edges are all just short enough, of their square


def fit_mesh(surface: Surface, views: Sequence[Observed], device: Device, unit: np.ndarray, *, flat: float,
             detail: float = DETAIL, least_views: int = 2, most: int) -> tuple[Subdivision, Solved, np.ndarray]:
    """Move the vertices of `surface` as solve_mesh does, its edges split where the depth maps lie off their middles by
    more than twice `flat` footprints, at most to `most` triangles: the largest deviations first.

    `unit` (V,) is the footprint at each vertex, infinite where no view sees it. Gives how the mesh was split, where
    its vertices are, and which of them are at one place (V',).
    """
    mesh, views = _Splitting(surface, unit), sent(views, device)
    coarse = max(COARSE, detail) * mesh.coarsening(max(COARSE, detail), most)
    while len(mesh.all_longer(coarse)):
        pass
    orientation = None
    for level in range(_LEVELS + 1):
        now = OnDevice(device, mesh.welded())
        if orientation is None:
            orientation = orientation_of(now.surface, now.drawing, views)
        solved = solve_welded(now, views, least_views=least_views, orientation=orientation,
                              rounds=1 if level < _LEVELS else _ROUNDS)
        mesh.points = solved.vertices
        if level == _LEVELS:
            now.release()
            break
        pairs, of_face = long_edges(mesh.points, mesh.place[mesh.faces], detail * mesh.unit)
        off = off_middles(now, mesh.points, pairs, views, orientation, least_views)
        now.release()
        wanted, count = np.flatnonzero(off > _OFF * flat), len(mesh.faces)
        done = mesh.split_longest_with(wanted[np.argsort(-off[wanted], kind="stable")], pairs, of_face, most)
        if done < len(wanted):
            log.warning("mesh: %d edges are not split though depth maps show detail there: %d triangles are all that "
                        "the memory is for", len(wanted) - done, most)
        log.info("mesh: level %d, %d of %d edges lie off by more than %g footprints, %d -> %d triangles", level + 1,
                 len(wanted), len(pairs), _OFF * flat, count, len(mesh.faces))
    division = Subdivision(len(surface.vertices), surface.faces, mesh.faces, mesh.rounds)
    return division, solved.at(mesh.place), mesh.place


class _Splitting:
    """A mesh while it is split: `points` (W, 3) are its places, `place` (V,) that of each vertex, `faces` name
    vertices."""

    def __init__(self, surface: Surface, unit: np.ndarray):
        self.points, self.place = welded(surface.vertices)
        self.unit = np.full(len(self.points), np.inf)
        np.minimum.at(self.unit, self.place, unit)
        self.faces: np.ndarray = surface.faces
        self.unit = spread(self.unit, self.place[self.faces])
        self.rounds: list[np.ndarray] = []

    def welded(self) -> Surface:
        return Surface(self.points, with_area(self.place[self.faces]))

    def coarsening(self, edges: float, most: int) -> float:
        """By how much longer edges than `edges` footprints must be to leave half of `most` triangles to the detail."""
        corners = self.points[self.place[self.faces]]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        needed = (area / (_FACE * (edges * self.unit[self.place[self.faces]].min(axis=1)) ** 2)).sum()
        return float(np.sqrt(max(1.0, needed / max(1, most // 2))))

    def all_longer(self, edges: float) -> np.ndarray:
        """Split all edges longer than `edges` footprints, and give them."""
        pairs, of_face = long_edges(self.points, self.place[self.faces], edges * self.unit)
        self._split(pairs, of_face)
        return pairs

    def split_longest_with(self, wanted: np.ndarray, pairs: np.ndarray, of_face: np.ndarray, most: int) -> int:
        """Split the edges `wanted` of `pairs`, and with them the longest edge of each of their faces: no slivers. So
        many of the first ones as make at most `most` faces; how many."""
        length = np.linalg.norm(self.points[pairs[:, 0]] - self.points[pairs[:, 1]], axis=1)
        sides = np.append(length, -1.0).astype(np.float32)[of_face]
        longest = np.take_along_axis(of_face, sides.argmax(axis=1)[:, None], axis=1)[:, 0]
        while True:
            chosen = np.zeros(len(pairs) + 1, bool)            # the last: of sides that are none of them
            chosen[wanted] = True
            more = longest[chosen[of_face].any(axis=1)]
            while not chosen[more].all():
                chosen[more] = True
                more = longest[chosen[of_face].any(axis=1)]
            added, room = np.count_nonzero(chosen[of_face]), max(0, most - len(self.faces))
            if added <= room:
                break
            wanted = wanted[:int(0.95 * len(wanted) * room / added)]
        number = np.where(chosen, np.cumsum(chosen) - 1, -1)
        self._split(pairs[chosen[:-1]], number[of_face])
        return len(wanted)

    def _split(self, pairs: np.ndarray, of_face: np.ndarray) -> None:
        count, here = len(self.place), of_face >= 0
        if not len(pairs):
            return
        a, b = self.faces[here].astype(np.int64), self.faces[:, [1, 2, 0]][here]
        found, first, number = np.unique(np.minimum(a, b) * count + np.maximum(a, b), return_index=True,
                                         return_inverse=True)
        middles = np.full(of_face.shape, -1, np.int32)
        middles[here] = count + number.reshape(-1)
        self.place = np.concatenate([self.place, (len(self.points) + of_face[here][first]).astype(np.int32)])
        self.rounds.append(np.stack(np.divmod(found, count), axis=1).astype(np.int32))
        self.faces, _ = split(self.faces, middles)
        self.points = with_middles(self.points, pairs)
        self.unit = np.concatenate([self.unit, self.unit[pairs].min(axis=1)])


def off_middles(mesh: OnDevice, vertices: np.ndarray, pairs: np.ndarray, views: Sequence[Observed], orientation: float,
                least_views: int) -> np.ndarray:
    """How far, in footprints, the depth maps lie off the middles of the edges `pairs` of the mesh, its vertices at
    `vertices`; 0 where too few views agree."""
    from pagas_cl.runtime.device import translate_cl_errors
    from pagas_cl.runtime.memory import download, upload
    from pagas_cl.runtime.program import bind, run_once

    if not len(pairs):
        return np.zeros(0, np.float32)
    device, count = mesh.device, len(vertices)
    with translate_cl_errors(device, "the deviations of the mesh"):
        mesh.drawing.move(vertices)
        whole = {"positions": upload(device, mesh.in_frame(vertices)), "edges": upload(device, pairs.astype(np.int32))}
        own = {name: device.memory.buffer(device.context, 4 * size * len(pairs), name)
               for name, size in (("positions", 3), ("normals", 3), ("reach", 1))}
        words = Words(device, len(pairs), own)
        for name, size in (("normals", 3), ("reach", 1), ("flatness", 1)):
            whole[name] = device.memory.buffer(device.context, 4 * size * count, name)
        run_once(device.queue, [
            bind(words.program, "vertex_normals", (count,), None, {**mesh.rings, **whole}, count=count),
            bind(words.program, "edge_middles", (len(pairs),), None, positions=whole["positions"],
                 normals=whole["normals"], pairs=whole["edges"], count=len(pairs), middles=own["positions"],
                 directions=own["normals"], reach=own["reach"])])
        for buffer in whole.values():
            buffer.release()
        for view in views:
            words.ask(mesh.drawing, view, orientation)
        words.settle(least_views)
        off, unit, seen = (download(device, words.known[name], len(pairs), kind) for name, kind in
                           (("target", np.float32), ("unit", np.float32), ("seen", np.int32)))
        words.release()
        for buffer in own.values():
            buffer.release()
    return np.where(seen >= least_views, np.abs(off) / unit, 0)
