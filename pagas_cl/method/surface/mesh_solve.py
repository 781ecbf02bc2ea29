"""All vertices of a mesh at once onto refined depth maps, on a device (method section 10.3): one unknown each, its way
along the normal; what views say of it, a smoothness that lets go at creases, and where nothing is said it stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pagas_cl.errors import log
from pagas_cl.method.surface.mesh_evidence import Observed, Words
from pagas_cl.scene.mesh import Surface

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

LAMBDA, STAY, CREASE, JUMP = 3.0, 0.15, 0.1, 0.5
ROUNDS, LINKINGS, STEPS = 3, 2, 30      # of evidence, of links between neighbours, of conjugate gradients
_HOLDS = 8                              # times that ways are halved where triangles would turn over
_FOLLOWS = 16                           # times that vertices on creases follow the planes there
_GROUP = 128
DEFINES = (f"GROUP={_GROUP}",)
_SAMPLES, _ASKED = 20_000, 8            # triangles and views that tell which way normals point


@dataclass(frozen=True, eq=False)
class Solved:
    """Where the vertices are now, (V, 3) float64, those that did not move bit for bit; views that agree on each (V,);
    standard deviation (V,), scene units, infinite where nothing was said; footprint (V,), infinite where no view sees
    it; how many vertices were held back since a triangle would have turned over."""

    vertices: np.ndarray = field(repr=False)
    seen: np.ndarray = field(repr=False)
    deviation: np.ndarray = field(repr=False)
    unit: np.ndarray = field(repr=False)
    held: int = 0

    def at(self, place: np.ndarray) -> Solved:
        """The same of vertices that have these places (or of some of them)."""
        return Solved(self.vertices[place], self.seen[place], self.deviation[place], self.unit[place], self.held)


def solve_mesh(surface: Surface, views: Sequence[Observed], device: Device, *, least_views: int = 2,
               rounds: int = ROUNDS) -> Solved:
    """Move the vertices of `surface` along their normals onto what at least `least_views` of the views agree on.

    Vertices at the very same place stay together. Without evidence a vertex follows its neighbours over two or three
    edges and stays beyond.
    """
    points, place = welded(surface.vertices)
    mesh = OnDevice(device, Surface(points, with_area(place[surface.faces])))
    solved = solve_welded(mesh, views, least_views=least_views, rounds=rounds)
    mesh.release()
    return solved.at(place)


def welded(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of vertices, each once (W, 3), and which of them each vertex has, int32 (V,)."""
    alone = vertices, np.arange(len(vertices), dtype=np.int32)
    mixed = np.sort((vertices + 0.0).view(np.uint64) @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 1], np.uint64))
    if (mixed[1:] != mixed[:-1]).all():     # no need to sort by place, which takes twenty times as long
        return alone
    points, place = np.unique(vertices, axis=0, return_inverse=True)
    if len(points) == len(vertices):
        return alone
    return points, place.reshape(-1).astype(np.int32)


def unlike(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which vertices (V, 3) are not where they were: bool (V,)."""
    x, y, z = (before != after).T       # any(axis=1) takes six times as long
    return x | y | z


def with_area(faces: np.ndarray) -> np.ndarray:
    """The faces whose three corners are at three places."""
    a, b, c = faces.T
    there = (a != b) & (b != c) & (c != a)
    return faces if there.all() else faces[there]


class OnDevice:
    """A mesh on a device, each place once and no face without area: its drawing, and what is around its vertices."""

    def __init__(self, device: Device, surface: Surface):
        from pagas_cl.method.surface.raster import Drawing
        from pagas_cl.runtime.memory import upload

        self.device, self.surface, self.drawing = device, surface, Drawing(device, surface)
        first, pairs = around(surface.faces, len(surface.vertices))
        self.corners, self.rings = len(pairs), {"first": upload(device, first), "pairs": upload(device, pairs)}

    def in_frame(self, vertices: np.ndarray) -> np.ndarray:
        """Places (V, 3) as kernels take them, float32."""
        local: np.ndarray = ((vertices - self.drawing.middle) / self.drawing.unit).astype(np.float32)
        return local

    def release(self) -> None:
        for buffer in self.rings.values():
            buffer.release()


def around(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each vertex' corners begin, int32 (V + 1,), and of each the two other corners of its triangle, (3 F, 2)."""
    others = np.empty((*faces.shape, 2), np.int32)
    for side in range(3):
        others[:, side, 0], others[:, side, 1] = faces[:, side - 2], faces[:, side - 1]
    first, order = grouped(faces.reshape(-1), count)
    return first, others.view(np.int64).reshape(-1)[order].view(np.int32).reshape(-1, 2)


def grouped(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each of `count` numbers begins in their order, int32 (count + 1,), and that order (N,) int32: what is equal
    stays as it came. A fifth of the time of an argsort."""
    key = numbers.astype(np.int64)
    key <<= 32
    key |= np.arange(len(numbers))
    key.sort()
    first = np.concatenate([[0], np.cumsum(np.bincount(numbers, minlength=count))])
    return first.astype(np.int32), (key & 0xFFFFFFFF).astype(np.int32)


def solve_welded(mesh: OnDevice, views: Sequence[Observed], *, least_views: int, rounds: int,
                 orientation: float | None = None) -> Solved:
    """solve_mesh of a mesh on its device; `orientation` as orientation_of says."""
    from pagas_cl.runtime.device import translate_cl_errors
    from pagas_cl.runtime.memory import download, upload
    from pagas_cl.runtime.program import bind, run_once

    with translate_cl_errors(mesh.device, "the solve of the mesh"):
        device, surface, drawing, count = mesh.device, mesh.surface, mesh.drawing, len(mesh.surface.vertices)
        start = mesh.in_frame(surface.vertices)
        own: dict[str, Any] = {"positions": upload(device, start)}
        for name, size in (("normals", 3), ("moved", 3), ("delta", 1), ("held", 1), ("reach", 1), ("flatness", 1)):
            own[name] = device.memory.buffer(device.context, 4 * size * count, name)
        vertices, held = surface.vertices, 0
        if orientation is None:
            orientation = orientation_of(surface, drawing, views)
        for number in range(rounds):
            known = {**mesh.rings, **own}
            words = Words(device, count, known, least_views)
            run_once(device.queue, [bind(words.program, "vertex_normals", (count,), None, known, count=count)])
            if number:
                drawing.move(vertices)
            for view in views:
                words.ask(drawing, view, orientation)
            words.settle()
            unit = download(device, words.known["unit"], count)
            found = np.isfinite(unit)
            if not found.any():
                seen, sigma = np.zeros(count, np.int32), np.full(count, np.inf, np.float32)
                break
            middle = float(np.median(unit[found]))
            words.known["unit"].release()
            words.known["unit"] = upload(device, np.where(found, unit, np.float32(middle)))
            _Gradients(device, count, mesh.corners, {**known, **words.known}, 1 / middle).run()
            held = _move(device, count, {**known, **words.known}, 1 / middle)
            seen, sigma = (download(device, words.known[name], count, kind) for name, kind in
                           (("seen", np.int32), ("sigma", np.float32)))
            words.release()
            own["positions"], own["moved"] = own["moved"], own["positions"]
            place = download(device, own["positions"], (count, 3))
            moved = unlike(place, start)
            way = (place - start).astype(np.float64) * drawing.unit
            vertices = np.where(moved[:, None], surface.vertices + way, surface.vertices)
            log.debug("mesh: round %d, %.0f %% of %d vertices have evidence, moved by %.3g footprints (root mean "
                      "square)", number + 1, 100 * (np.isfinite(sigma)).mean(), count,
                      np.sqrt(np.square(place - start).sum(axis=1).mean()) / middle)
        for buffer in own.values():
            buffer.release()
        return Solved(vertices, seen, sigma.astype(np.float64) * drawing.unit, unit * drawing.unit, held)


class _Gradients:
    """Conjugate gradients of one round: buffers, and the launches of a step."""

    def __init__(self, device: Device, count: int, corners: int, known: dict[str, Any], scale: float):
        from pagas_cl.runtime.program import build

        self.device, self.count = device, count
        self.groups = -(-count // _GROUP)
        self.program = build(device, "mesh_solve.cl", DEFINES)
        self._own = {name: device.memory.buffer(device.context, 4 * size, name) for name, size in
                     (("links", 2 * corners), ("sums", count), ("inverse_diagonal", count), ("residual", count),
                      ("p", count), ("q", count), ("y", count), ("partial", self.groups), ("scalars", 3))}
        self._known = {**known, **self._own, "count": count, "scale": scale, "lambda": LAMBDA, "stay": STAY,
                       "groups": self.groups}

    def _bound(self, name: str, items: int | None = None, **more: Any) -> Any:
        from pagas_cl.runtime.program import bind

        signature = self.program.signatures[name]
        given = {key: value for key, value in self._known.items() if key in signature}
        return bind(self.program, name, (items or self.count,), (_GROUP,), {}, **{**given, **more})

    def run(self) -> None:
        """Ways delta of all vertices, in the buffer of that name, in median footprints."""
        import pyopencl as cl

        from pagas_cl.runtime.program import run_once

        cl.enqueue_fill_buffer(self.device.queue, self._known["delta"], np.float32(0), 0, 4 * self.count)
        for _ in range(LINKINGS):
            run_once(self.device.queue, [self._bound("find_links", crease=CREASE, jump=JUMP), self._bound("find_sums"),
                                         self._bound("apply_laplacian", x=self._known["delta"]),
                                         self._bound("apply_matrix", p=self._known["delta"]), self._bound("start"),
                                         self._bound("advance", step=0, first_time=1),
                                         self._bound("add_up", _GROUP, which=0),
                                         self._bound("turn", step=0, first_time=1)])
            laplacian = self._bound("apply_laplacian", x=self._own["p"])
            matrix, product = self._bound("apply_matrix"), self._bound("add_up", _GROUP, which=2)
            steps = [(self._bound("advance", step=k, first_time=0), self._bound("add_up", _GROUP, which=1 - k),
                      self._bound("turn", step=1 - k, first_time=0)) for k in (0, 1)]
            for step in range(STEPS):
                for launch in (laplacian, matrix, product, *steps[step & 1]):
                    launch.enqueue(self.device.queue)
            for launch in (laplacian, matrix, product, *steps[0], *steps[1]):
                launch.release()
        self.device.queue.finish()
        for buffer in self._own.values():
            buffer.release()


def _move(device: Device, count: int, known: dict[str, Any], scale: float) -> int:
    """Places along the ways, in the buffer "moved"; no triangle turns over. How many vertices were held back."""
    import pyopencl as cl

    from pagas_cl.runtime.memory import download
    from pagas_cl.runtime.program import bind, build, run_once

    program = build(device, "mesh_solve.cl", DEFINES)
    cl.enqueue_fill_buffer(device.queue, known["held"], np.int32(0), 0, 4 * count)
    move = {name: known[name] for name in ("positions", "normals", "unit", "weight", "flatness", "delta", "moved")}
    hold = {name: known[name] for name in ("positions", "moved", "first", "pairs", "delta", "held")}
    ways, follow = (known["moved"], known["words"]), {name: known[name] for name in (
        "positions", "first", "pairs", "flatness", "normals", "delta")}
    cl.enqueue_fill_buffer(device.queue, ways[0], np.float32(0), 0, 12 * count)
    run_once(device.queue, [bind(program, "follow_planes", (count,), None, follow, count=count,
                                 before=ways[turn & 1], ways=ways[1 - (turn & 1)], last=int(turn == _FOLLOWS - 1))
                            for turn in range(_FOLLOWS)])
    for turn in range(_HOLDS):
        run_once(device.queue, [bind(program, "move", (count,), None, move, count=count, scale=scale),
                                bind(program, "hold_back", (count,), None, hold, count=count,
                                     last=int(turn >= _HOLDS - 4))])
    run_once(device.queue, [bind(program, "move", (count,), None, move, count=count, scale=scale)])
    return int(np.count_nonzero(download(device, known["held"], count, np.int32)))


def orientation_of(surface: Surface, drawing: Any, views: Sequence[Observed]) -> float:
    """1 where the triangles that cameras see face them, -1 where they face away, 0 where they do as it comes."""
    step, votes, number = max(1, len(surface.faces) // _SAMPLES), 0, 0
    a, b, c = (surface.vertices[surface.faces[::step, k]] for k in range(3))
    across, middle = np.cross(b - a, c - a), (a + b + c) / 3
    for place in range(0, len(views), -(-len(views) // _ASKED)):
        camera = views[place].camera
        uv, z = camera.project(middle)
        inside = np.flatnonzero(camera.holds(uv, z))
        column, row = uv[inside].astype(int).T
        near = np.abs(drawing.depth(camera)[row, column] - z[inside]) < z[inside] / camera.fx
        toward = ((camera.center - middle[inside[near]]) * across[inside[near]]).sum(axis=1)
        votes, number = votes + int(np.sign(toward).sum()), number + len(toward)
    return float(np.sign(votes)) if abs(votes) > 0.7 * number else 0.0
