"""A mesh onto refined depth maps, coarse to fine, as fine as they show detail (method section 10.4).

First edges longer than COARSE are split whatever depth maps show; then, level by level, those longer than `detail`
whose middle depth maps lie off by most of the tolerance, and with each the longest edge of each of its triangles."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from pagas_cl.errors import log
from pagas_cl.method.surface.mesh_evidence import Observed, VertexObservations
from pagas_cl.method.surface.mesh_mending import Faults, without_new
from pagas_cl.method.surface.mesh_rings import grouped
from pagas_cl.method.surface.mesh_solve import OnDevice, Solved, orientation_of, solve_welded
from pagas_cl.method.surface.raster import Drawing
from pagas_cl.method.surface.subdivide import Splitting, Subdivision
from pagas_cl.method.surface.weld import with_area
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import bind, run_once
from pagas_cl.scene.mesh import Surface, triangle_normals

# Constants of section 10.4.
COARSE = 12.0               # footprints: longest edge to begin with,
_SMALL = 6.0                # and of a smaller size, at which edges are not split by what depth maps show
DETAIL = 1.5                # footprints: longest edge that is never split; shorter ones show noise
TOLERANCE = 0.025           # footprints: how far off triangles are that need not be smaller,
UNSURE = 0.4                # or such a share of the standard deviation there, where that is more,
_SUREST = 0.25              # of this share of the surface, the surest, but
_FARTHEST = 0.15            # footprints: no more than that; beyond, corners and steps of the surface go
_OFF = 0.8                  # times the tolerance that the middle of an edge lies off, for which it is split
_SURE = (1.0, 1.0, 2.0)     # and standard deviations of what depth maps say of it, level by level: less may be noise
_AT_SIZE = 3                # rounds of the solve at each smaller size
_ROUNDS = 2                 # of the solve after the last level
_FULL = 0.9                 # of the triangles that there is room for, from which on nothing more is split
_SAMPLES = 100_000          # triangles by which the tolerance is found
_DENSEST = 13.5             # triangles made on a square of `detail`: only slivers reach it, others half (measured)
TRIANGLE_BYTES = 450        # of host and device memory together, at the peak (measured)
_DONE = (0.0, 0.12, 0.25)   # of all that makes the mesh when a level begins, but the last one (measured);
_SPLIT, _AFTER = 3.0, 1     # rounds of the solve, by time: an earlier level; what comes after the last one


def fit_mesh(surface: Surface, views: Sequence[Observed], device: Device, unit: np.ndarray, component: np.ndarray, *,
             tolerance: float | None = None, detail: float = DETAIL, least_views: int = 2, most: int, least: int = 0,
             smaller: Iterable[tuple[float, Sequence[Observed]]] = (),
             at: Callable[[float], object] = lambda share: None,
             note: Callable[[str], object] = log.warning) -> tuple[Subdivision, Solved, np.ndarray, Faults]:
    """Move the vertices of `surface` as solve_mesh does, its edges split by the rule above, to `most` triangles, the
    largest deviations first, and to `least`, the longest edges first. `smaller`: sizes, and views at them, by which
    vertices are moved first. `tolerance` as in tolerance_of; `unit` (V,) is the footprint at each vertex, infinite
    where no view sees it, `component` (V,) its connected component. `at(share)` is a callback with how much is done
    where the last level begins; `note(sentence)` one with why edges were not split against the rule. Gives how the mesh
    was split, where its vertices are, which are at one place (V',), and what is wrong with the triangles."""
    mesh = _Splitting(surface, unit)
    room = min(most, mesh.most_shown(detail))
    orientation = orientation_of(surface, Drawing(device, surface), views)
    left = 0
    for size, small in smaller:
        mesh.split_longer(max(_SMALL, detail) / size, room // 2)
        faults = mesh.go_toward(small, device, orientation, least_views, component)
        left += faults.new
        log.debug("mesh: at %g of the size: %s", size, faults)
    mesh.split_longer(max(COARSE, detail), room // 2)
    split = 0.0     # triangles times rounds of the levels so far
    for level in range(len(_SURE) + 1):
        last = level == len(_SURE) or len(mesh.edges) > _FULL * room
        rounds = _ROUNDS + (level < len(_SURE)) if last else 1
        if last and level == 0 and room == most and len(mesh.edges.longer(mesh.points, detail * mesh.unit)):
            note(f"the mesh is coarser than the depth maps would allow: it began with {len(mesh.edges)} triangles, and "
                 f"there is room for {most} (--memory, or memory of refine_mesh; at most one for each pixel)")
        if last:
            mesh.split_longest(min(least, most))
        at(split / (split + (rounds + _AFTER) * len(mesh.edges)) if last else _DONE[level])
        split += _SPLIT * len(mesh.edges)
        now = OnDevice(device, Surface(mesh.points, with_area(mesh.edges.faces)))
        solved = solve_welded(now, views, least_views=least_views, orientation=orientation, rounds=rounds)
        mesh.points = solved.vertices
        if last:
            now.release()
            break
        lengths = mesh.edges.lengths(mesh.points)
        long = np.flatnonzero(lengths > detail * np.maximum(*mesh.unit[mesh.edges.ends.T]))
        off = off_middles(now, mesh.points, mesh.edges.ends[long], views, orientation, least_views, _SURE[level])
        now.release()
        enough = _OFF * tolerance_of(tolerance, now.surface.faces, solved)
        wanted, count = off > enough, len(mesh.edges)
        number, done = np.count_nonzero(wanted), mesh.split_longest_with(
            device, long, wanted, off, lengths, room)
        if done < number and room < most:
            note(f"the mesh is coarser than the depth maps would allow, at {number - done} edges: its triangles are so "
                 f"narrow that {room} are more than depth maps can show; remesh it first")
        elif done < number:
            note(f"the mesh is coarser than the depth maps would allow, at {number - done} edges: the memory planned "
                 f"for it holds {most} triangles; give it more: --memory, or memory of refine_mesh")
        log.debug("mesh: level %d, %d of %d edges lie off by more than %g footprints, %d -> %d triangles", level + 1,
                  number, len(long), enough, count, len(mesh.edges))
    division, place, start = mesh.division(), mesh.place, mesh.began()
    del mesh        # before more memory is needed
    solved = solved.at(place)
    vertices, faults = without_new(device, surface, division, solved.vertices, component, start, place)
    return division, replace(solved, vertices=vertices), place, replace(faults, new=faults.new + left)


def tolerance_of(requested: float | None, faces: np.ndarray, solved: Solved) -> float:
    """How far triangles may lie off, footprints: as requested or, where nobody said, UNSURE of what the surest part of
    the surface of these faces (F, 3) is unsure by, from TOLERANCE to _FARTHEST: smaller ones would show noise."""
    if requested is not None:
        return requested
    corners = faces[::max(1, len(faces) // _SAMPLES)]
    unit, deviation = (np.take(values, corners.T).max(axis=0) for values in (solved.unit, solved.deviation))
    known = np.isfinite(deviation)
    if not known.any():
        return TOLERANCE
    a, b, c = (solved.vertices[corners[known, k]] / unit[known, None] for k in range(3))
    area, unsure = np.linalg.norm(np.cross(b - a, c - a), axis=1), deviation[known] / unit[known]
    order = np.argsort(unsure, kind="stable")
    below = np.cumsum(area[order])
    return float(np.clip(UNSURE * unsure[order][np.searchsorted(below, _SUREST * below[-1])], TOLERANCE, _FARTHEST))


class _Splitting(Splitting):
    """A surface that is split, and moved, by what views show."""

    def __init__(self, surface: Surface, unit: np.ndarray):
        super().__init__(surface.vertices, surface.faces, unit)
        self.surface = surface

    def began(self) -> np.ndarray | None:
        """Where the way of the vertices begins, (V, 3); None where they were given."""
        return None if self.start is None else self.start[self.place]

    def go_toward(self, views: Sequence[Observed], device: Device, orientation: float, least_views: int,
                  component: np.ndarray) -> Faults:
        """Move the vertices where the views say, and let them start there anew; what is wrong with the triangles."""
        now = OnDevice(device, Surface(self.points, with_area(self.edges.faces)))
        solved = solve_welded(now, views, least_views=least_views, orientation=orientation, rounds=_AT_SIZE)
        now.release()
        vertices, faults = without_new(device, self.surface, self.division(), solved.vertices[self.place],
                                       component, self.began(), self.place)
        self.points = np.empty_like(self.points)
        self.points[self.place] = vertices
        self.start = self.points
        return faults

    def most_shown(self, detail: float) -> int:
        """How many triangles depth maps can show, besides those that are there: by area, whatever their shape."""
        corners = self.edges.table[:3]
        unit = self.unit[corners].max(axis=0)
        area = 0.5 * np.linalg.norm(triangle_normals(self.points, corners.T), axis=1) / unit**2
        return len(self.edges) + int(_DENSEST / detail**2 * area.sum())

    def split_longer(self, longest: float, most: int) -> None:
        """Split edges until none is longer than `longest` footprints, or there would be more than `most` faces."""
        fresh: np.ndarray | slice = slice(None)
        while len(chosen := self.edges.longer(self.points, longest * self.unit, fresh)):
            if len(self.edges) + 2 * len(chosen) > most:
                break
            fresh = self.split(chosen)

    def split_longest(self, least: int) -> None:
        """Split the longest edges that views see until there are at least so many faces."""
        while (missing := least - len(self.edges)) > 0:
            unit = np.maximum(*self.unit[self.edges.ends.T])
            length = np.where(np.isfinite(unit), self.edges.lengths(self.points) / unit, 0)
            order = np.argsort(-length, kind="stable")[:-(-missing // 2)]
            order = order[length[order] > length.max() / 2]
            if not len(order):
                break
            self.split(self.edges.in_order(order))

    def split_longest_with(self, device: Device, long: np.ndarray, wanted: np.ndarray, off: np.ndarray,
                           lengths: np.ndarray, most: int) -> int:
        """Split those of the edges `long` that are `wanted`, and with them the longest of each of their faces: no
        slivers. So many of those that lie `off` farthest as make at most `most` faces; how many."""
        sides, count = self.edges.sides, len(self.edges.ends)
        first = self.edges.in_order(long[wanted])
        by_edge = np.zeros(count, np.float32)
        by_edge[long] = off
        first = first[np.argsort(-by_edge[first], kind="stable")]
        size = np.full(count, -1, np.float32)
        size[long] = lengths[long]
        longest = np.where(size[sides[1]] > size[sides[0]], sides[1], sides[0])
        longest = np.where(size[sides[2]] > size[longest], sides[2], longest)
        sent = upload(device, sides.reshape(-1))
        buffers = grouped(device, sent, sides.size, count)
        begin, order = (download(device, buffer, buffer.nbytes // 4, np.int32) for buffer in buffers)
        release(sent, *buffers)
        longest_around = longest[order % len(self.edges)]       # edge after edge, of each face that it is a side of
        done, room = len(first), max(0, most - len(self.edges))
        while True:
            split = _with_longest(first[:done], begin, longest_around)
            added = sum(np.count_nonzero(split[side]) for side in sides)
            if added <= room:
                break
            done = int(0.95 * done * room / added)
        self.split(self.edges.in_order(np.flatnonzero(split)))
        return done


def _with_longest(first: np.ndarray, begin: np.ndarray, longest_around: np.ndarray) -> np.ndarray:
    """Which edges are split with those of the numbers `first`: bool (E,). The longest sides of the faces around edge e
    are longest_around[begin[e]:begin[e + 1]]. Each edge is looked at once, however many faces it or a vertex has."""
    split = np.zeros(len(begin) - 1, bool)
    fresh = first
    while len(fresh):
        split[fresh] = True
        counts = begin[fresh + 1] - begin[fresh]
        skipped = np.repeat(begin[fresh] - np.cumsum(counts) + counts, counts)
        longest = longest_around[skipped + np.arange(counts.sum())]
        fresh = np.unique(longest[~split[longest]])
    return split


def off_middles(mesh: OnDevice, vertices: np.ndarray, pairs: np.ndarray, views: Sequence[Observed], orientation: float,
                least_views: int, sure: float) -> np.ndarray:
    """How far, footprints, depth maps lie off middles of the edges `pairs`; 0: few agree, or within `sure` sigma."""
    if not len(pairs):
        return np.zeros(0, np.float32)
    device, count = mesh.device, len(vertices)
    with translate_cl_errors(device, "the deviations of the mesh"):
        mesh.drawing.move(vertices)
        whole = {"positions": upload(device, mesh.drawing.frame.local(vertices)),
                 "edges": upload(device, pairs.astype(np.int32))}
        own = {name: device.buffer(4 * size * len(pairs), name)
               for name, size in (("positions", 3), ("normals", 3), ("reach", 1))}
        observations = VertexObservations(device, len(pairs), own, least_views)
        for name, size in (("normals", 3), ("reach", 1), ("flatness", 1)):
            whole[name] = device.buffer(4 * size * count, name)
        run_once(device.queue, [
            bind(observations.program, "vertex_normals", (count,), None, {**mesh.rings, **whole}, count=count),
            bind(observations.program, "edge_middles", (len(pairs),), None, positions=whole["positions"],
                 normals=whole["normals"], pairs=whole["edges"], count=len(pairs), middles=own["positions"],
                 directions=own["normals"], reach=own["reach"])])
        release(*whole.values())
        observations.gather(mesh.drawing, views, orientation)
        off, unit, sigma, seen = (download(device, observations.known[name], len(pairs), kind) for name, kind in (
            ("target", np.float32), ("unit", np.float32), ("sigma", np.float32), ("seen", np.int32)))
        observations.release()
        release(*own.values())
    off = np.abs(off)
    return np.where((seen >= least_views) & (off > sure * sigma), off / unit, 0)
