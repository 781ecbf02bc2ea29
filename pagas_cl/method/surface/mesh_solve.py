"""All vertices of a mesh at once onto refined depth maps, on a device (method section 10.3): one unknown each, its
displacement along the normal; what views say of it, a smoothness that lets go at creases, and where nothing is said it
stays."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.errors import log
from pagas_cl.method.surface.mesh_evidence import Observed, VertexObservations
from pagas_cl.method.surface.mesh_rings import rings_of
from pagas_cl.method.surface.raster import Drawing
from pagas_cl.method.surface.weld import unlike, welded, with_area
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import Launch, Program, bind, build, run_once
from pagas_cl.scene.mesh import Surface

# Constants of section 10.3 (figures: tests/bench).
LAMBDA = 3.0            # weight of the smoothness, against MOST_WEIGHT of the evidence: higher is smoother
STAY = 0.15             # weight of staying where no view sees the surface: higher reaches fewer edges;
SEEN = 0.01             # where views see it, but too few of them agree
CREASE = 0.1            # 1 - cosine between normals from which on neighbours are linked by half
JUMP = 0.5              # difference of displacements, of the edge between them, from which on they are
ROUNDS = 3              # of evidence, where edges are not split
LINKINGS = 2            # times that links between neighbours are found in a round
STEPS = 30              # of conjugate gradients for each
_HOLDS = 8              # times that displacements are halved where triangles would turn over; dropped in the last 4
_FOLLOWS = 16           # times that vertices on creases follow the planes there
_GROUP = 128            # work-items of a group
DEFINES = (f"GROUP={_GROUP}",)
_SAMPLES = 20_000       # triangles by which it is decided whether normals point to the cameras,
_VIEWS = 8              # and views


@dataclass(frozen=True, eq=False)
class Solved:
    """Where the vertices are, (V, 3) float64, those that stay bit for bit; views that agree on each (V,); standard
    deviation (V,), scene units, infinite: nothing said; footprint (V,), infinite: not seen; how many were held back."""

    vertices: np.ndarray = field(repr=False)
    seen: np.ndarray = field(repr=False)
    deviation: np.ndarray = field(repr=False)
    unit: np.ndarray = field(repr=False)
    held: int = 0

    def at(self, place: np.ndarray) -> "Solved":
        """The same of vertices that have these places (or of some of them)."""
        vertices = np.take(self.vertices, place, axis=0)
        return Solved(vertices, self.seen[place], self.deviation[place], self.unit[place], self.held)


def solve_mesh(surface: Surface, views: Sequence[Observed], device: Device, *, least_views: int = 2,
               rounds: int = ROUNDS) -> Solved:
    """Move the vertices of `surface` along their normals onto what at least `least_views` of the views agree on.
    Vertices at the very same place stay together. Without evidence a vertex follows its neighbours over four edges,
    where no view sees it over two, and stays beyond."""
    points, place = welded(surface.vertices)
    mesh = OnDevice(device, Surface(points, with_area(place[surface.faces])))
    solved = solve_welded(mesh, views, least_views=least_views, rounds=rounds)
    mesh.release()
    return solved.at(place)


class OnDevice:
    """A mesh on a device, each place once and no face without area: its drawing, and what is around its vertices."""

    def __init__(self, device: Device, surface: Surface):
        self.device, self.surface, self.drawing = device, surface, Drawing(device, surface)
        faces = upload(device, np.ascontiguousarray(surface.faces, np.int32))
        self.corners = surface.faces.size
        self.rings = rings_of(device, faces, len(surface.faces), len(surface.vertices))
        faces.release()

    def release(self) -> None:
        release(*self.rings.values())


def solve_welded(mesh: OnDevice, views: Sequence[Observed], *, least_views: int, rounds: int,
                 orientation: float | None = None) -> Solved:
    """solve_mesh of a mesh on its device; `orientation` as orientation_of says."""
    device, surface, drawing, held = mesh.device, mesh.surface, mesh.drawing, 0
    vertices, count, frame = surface.vertices, len(surface.vertices), drawing.frame
    with translate_cl_errors(device, "the solve of the mesh"):
        if orientation is None:
            orientation = orientation_of(surface, drawing, views)
        start = frame.local(vertices)
        own: dict[str, Any] = {"positions": upload(device, start)}
        for name, size in (("normals", 3), ("moved", 3), ("delta", 1), ("held", 1), ("reach", 1), ("flatness", 1)):
            own[name] = device.buffer(4 * size * count, name)
        for number in range(rounds):
            if number:
                drawing.move(vertices)
            observations = VertexObservations(device, count, {**mesh.rings, **own}, least_views)
            known = observations.known
            observations.program.run("vertex_normals", (count,), None, known, count=count)
            observations.gather(drawing, views, orientation)
            unit, sigma = (download(device, known[name], count) for name in ("unit", "sigma"))
            seen = download(device, known["seen"], count, np.int32)
            found = np.isfinite(unit)
            if found.any():
                middle = float(np.median(unit[found]))
                known["unit"].release()
                known["unit"] = upload(device, np.where(found, unit, np.float32(middle)))
                _find_displacements(device, count, mesh.corners, known, np.where(found, SEEN, STAY), 1 / middle)
                held = _move(device, count, known, 1 / middle)
            observations.release()
            if not found.any():      # no view sees it: nothing moves
                break
            own["positions"], own["moved"] = own["moved"], own["positions"]
            place = download(device, own["positions"], (count, 3))
            displacement = (place - start).astype(np.float64) * frame.unit
            vertices = np.where(unlike(place, start)[:, None], surface.vertices + displacement, surface.vertices)
            log.debug("mesh: round %d, %.0f %% of %d vertices have evidence, moved by %.3g footprints (root mean "
                      "square)", number + 1, 100 * np.isfinite(sigma).mean(), count,
                      np.sqrt(np.square(place - start).sum(axis=1).mean()) / middle)
        release(*own.values())
        return Solved(vertices, seen, sigma.astype(np.float64) * frame.unit, unit * frame.unit, held)


def _program(device: Device) -> Program:
    return build(device, "mesh_solve.cl", (*DEFINES, "ONE_ADDS") if device.info.kind == "CPU" else DEFINES)


def _find_displacements(device: Device, count: int, corners: int, known: dict[str, Any], stay: np.ndarray,
                        scale: float) -> None:
    """Displacements of all vertices, in median footprints, in the buffer "delta": by conjugate gradients. `stay` (V,):
    weight of staying where nothing is said."""
    groups, program = -(-count // _GROUP), _program(device)
    own = {name: device.buffer(4 * size, name) for name, size in
           (("links", 2 * corners), ("sums", count), ("inverse_diagonal", count), ("residual", count), ("p", count),
            ("q", count), ("y", count), ("partial", groups), ("scalars", 3))}
    own["stay"] = upload(device, stay.astype(np.float32))
    known = {**known, **own, "count": count, "scale": scale, "lambda": LAMBDA, "groups": groups, "crease": CREASE,
             "jump": JUMP}

    def bound(name: str, items: int = count, **more: Any) -> Launch:
        return bind(program, name, (items,), (_GROUP,), known, **more)

    cl.enqueue_fill_buffer(device.queue, known["delta"], np.float32(0), 0, 4 * count)
    for _ in range(LINKINGS):
        run_once(device.queue, [bound("find_links"), bound("apply_laplacian", x=known["delta"]),
                                bound("apply_matrix", p=known["delta"]), bound("start"),
                                bound("advance", step=0, first_time=1), bound("add_up", _GROUP, which=0),
                                bound("turn", step=0, first_time=1)])
        product = [bound("apply_laplacian", x=own["p"]), bound("apply_matrix"), bound("add_up", _GROUP, which=2)]
        steps = [(bound("advance", step=k, first_time=0), bound("add_up", _GROUP, which=1 - k),
                  bound("turn", step=1 - k, first_time=0)) for k in (0, 1)]
        for step in range(STEPS):
            for launch in (*product, *steps[step & 1]):
                launch.enqueue(device.queue)
        for launch in (*product, *steps[0], *steps[1]):
            launch.release()
    device.queue.finish()
    release(*own.values())


def _move(device: Device, count: int, known: dict[str, Any], scale: float) -> int:
    """Places along the displacements, in the buffer "moved", no triangle turned over; how many are held back."""
    program, known = _program(device), {**known, "count": count, "scale": scale}

    def run(name: str, **more: Any) -> None:
        program.run(name, (count,), None, known, **more)

    cl.enqueue_fill_buffer(device.queue, known["held"], np.int32(0), 0, 4 * count)
    before, after = known["moved"], known["observations"]      # these were resolved: their buffer is used again
    cl.enqueue_fill_buffer(device.queue, before, np.float32(0), 0, 12 * count)
    for number in range(_FOLLOWS):
        run("follow_planes", before=before, displacements=after, last=int(number == _FOLLOWS - 1))
        before, after = after, before
    for number in range(_HOLDS):
        run("move")
        run("hold_back", last=int(number >= _HOLDS - 4))
    run("move")
    return int(np.count_nonzero(download(device, known["held"], count, np.int32)))


def orientation_of(surface: Surface, drawing: Any, views: Sequence[Observed]) -> float:
    """1 where the triangles that cameras see face them, -1 where they face away, 0 where they do as may be."""
    step = max(1, len(surface.faces) // _SAMPLES)
    votes = number = 0
    a, b, c = (surface.vertices[surface.faces[::step, k]] for k in range(3))
    across, middle = np.cross(b - a, c - a), (a + b + c) / 3
    for place in range(0, len(views), -(-len(views) // _VIEWS)):
        camera = views[place].camera
        uv, z = camera.project(middle)
        inside = np.flatnonzero(camera.holds(uv, z))
        column, row = uv[inside].astype(int).T
        near = np.abs(drawing.depth(camera)[row, column] - z[inside]) < z[inside] / camera.fx
        toward = ((camera.center - middle[inside[near]]) * across[inside[near]]).sum(axis=1)
        votes += int(np.sign(toward).sum())
        number += len(toward)
    return float(np.sign(votes)) if abs(votes) > 0.7 * number else 0.0
