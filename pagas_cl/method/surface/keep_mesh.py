"""The given mesh, its vertices on the refined depths, all else as it was: `refine_mesh(..., output="mesh")` or
"displace"."""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError, InputError, log
from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.mesh_collapse import Collapsed, simplified
from pagas_cl.method.surface.mesh_evidence import REACH, Observations, sent
from pagas_cl.method.surface.mesh_levels import DETAIL, TRIANGLE_BYTES, fit_mesh, tolerance_of
from pagas_cl.method.surface.mesh_mending import Faults, without_new
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.surface.mesh_solve import ROUNDS, solve_mesh
from pagas_cl.method.surface.on_vertices import footprints, vertex_colors, vertex_confidence
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.surface.subdivide import subdivide as split_edges
from pagas_cl.method.surface.weld import component_of, share_cancelled, unlike, welded
from pagas_cl.progress import NONE, Progress, Stage, stage
from pagas_cl.runtime.device import open_device
from pagas_cl.runtime.host import available_mb
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.mesh import Mesh, Surface
from pagas_cl.scene.meshes.files import check_digits, losses, read_content, surface_of
from pagas_cl.scene.meshes.kinds import sits_on, to_surface, with_vertices
from pagas_cl.scene.meshes.obj import write_obj
from pagas_cl.scene.view import joined
from pagas_cl.system.files import differing

_MESH = MeshOptions("mesh")
_SHARE = 0.5               # of the free memory that the mesh may take
_PER_PIXEL = 1.0           # triangles that a pixel of a view can show: two on a square of mesh_levels.DETAIL
_FINER, _FINEST = 2, 8     # times the triangles requested that it is split to before it is simplified: least, most
_NEAR = 0.02               # share by which there may be more or fewer
_PERCENT = 100             # of the mesh's progress
_FITTED, _SOLVED = 0.8, 0.9    # shares of its time, measured: until the triangles are chosen, and until they lie right
_POLISH = 1                # rounds of the solve on a fused mesh, which lies on the depth maps
# Constants of section 10.2: shares of refined depths beyond 3 footprints of the given mesh: castle at half size 0.46
# (beyond 12: 0.06), five made scenes 0.02 to 0.30, DTU at half size 0.01.
_FAR = 0.35                # share from which on smaller sizes come first,
_STILL = 0.05              # and that which must lie beyond 3 footprints of a size for the next smaller one to come, too
_SIZES = (0.5, 0.25, 0.125, 0.0625)
_CANCELLED = 0.1           # share of vertices whose normals cancel: real meshes have up to 0.004, those of which one
                           # triangle in ten is turned 0.14
_EVERY = 4                 # rows and columns of which one is looked at


@dataclass(frozen=True, eq=False)
class KeptMesh:
    """The mesh, of the kind that was given; and in one sentence why it is coarser than its depth maps would allow,
    unchanged, or has another number of triangles than requested: empty where it is not."""

    mesh: Mesh
    limit: str = ""


def kept_mesh(mesh, views, results, config: Config, making: MeshOptions = _MESH, device=None,
              progress: Progress = NONE, make: Callable = with_vertices) -> KeptMesh:
    """A mesh of the kind of `mesh` (anything that refine_mesh takes; of a path a Surface) with everything that sits on
    it, its vertices where the refined depth maps say. `results` are what refine_views gave.

    "mesh": with as many triangles as the depth maps show detail: split by surface.mesh_levels, simplified by
    surface.mesh_collapse, and solved once more; where no vertex moved, the mesh is as it was. In the memory that
    mesh_room says.
    "displace": with the same triangles (surface.mesh_solve), or all edges split that are longer than `subdivide`.
    `making.note(text)` is a callback with what is wrong with triangles, before and after. `make` makes the mesh, of
    what with_vertices takes."""
    making.check()
    with stage(progress, "solve the mesh", _PERCENT) as solving:
        try:
            return _kept(mesh, views, results, config, making, device, solving, make)
        except DeviceMemoryError as error:
            fewer = ("split edges less (--subdivide, subdivide of refine_mesh: more footprints)" if making.subdivide
                     else "allow fewer triangles (--memory, or memory of refine_mesh)" if making.output == "mesh"
                     else "simplify it first")
            raise DeviceMemoryError(f"the mesh is too large for the device: {error}; {fewer}") from error


def _kept(mesh, views, results, config: Config, making: MeshOptions, device, solving: Stage, make: Callable):
    pairs = list(joined(views, results))
    views, used = [views[place] for place, _ in pairs], [result for _, result in pairs]
    surface = given = to_surface(mesh)
    mesh = given if isinstance(mesh, (str, Path)) else mesh
    points, place = welded(given.vertices)
    _warn_of_cancelled(points, place[given.faces])
    component = component_of(place, given.faces)
    division, device, cameras, limit = None, solve_device(device), [result.camera for result in used], ""
    observed, least_views, rounds = sent(used, device), _least_views(config), ROUNDS
    if making.output == "mesh":
        simple, vertices, first, limit = _fitted(given, component, used, observed, device, making, least_views,
                                                 _exact(mesh, making),
                                                 lambda share: solving.advance(_FITTED * _PERCENT * share))
        division, surface, rounds = simple, Surface(vertices, simple.faces), 1
    elif making.subdivide is not None:
        finest = footprints(given.vertices, cameras, each_depth(given, cameras, device))
        division = split_edges(given.vertices, given.faces, making.subdivide * finest)
        surface = Surface(division.vertices(given.vertices), division.faces)
    solved = solve_mesh(surface, observed, device, least_views=least_views, rounds=rounds)
    solving.advance(_PERCENT * _SOLVED)
    before = given.vertices if division is None else division.vertices(given.vertices)
    if making.output == "mesh":
        vertices, last = without_new(device, surface, None, solved.vertices, simple.vertices(component))
        faults = first.then(last)
    else:
        vertices, faults = without_new(device, given, division, solved.vertices, component)
    moved = unlike(vertices, before)
    log.debug("mesh: %d of %d vertices moved; %d were held back, since a triangle would have turned over", moved.sum(),
              len(moved), solved.held)
    log.debug("mesh: %s", faults)
    if making.note:
        making.note(f"mesh: {faults}")
    if not moved.any():
        log.warning("the mesh is unchanged: nowhere do two refined views agree on where it should be (refined: %d of "
                    "%d); %s", sum(not result.reason for result in used), len(used),
                    "check its cameras and photos with 'pagas-cl check'" if len(used) > 1 else
                    "refine more views, or fuse a new mesh (output='tsdf', --fuse)")
        if making.output == "mesh" and making.triangles is None:      # what was split in between showed no detail
            division, vertices, solved = None, given.vertices.copy(), solved.at(np.arange(len(given.vertices)))
    quality = np.where(moved, vertex_confidence(vertices, used), 0) if moved.any() else None
    solving.advance(_PERCENT)
    if not moved.any() and division is None:
        limit = "unchanged: nowhere do two refined views agree on where it should be"
    elif limit:
        log.warning("%s", limit)
    if making.color:
        given_colors = given.colors if given.colors is None or division is None else division.vertices(given.colors)
        make = partial(make, colors=vertex_colors(vertices, views, used, given_colors))
    made = make(mesh, vertices, division, quality, {"deviation": solved.deviation, "views": solved.seen})
    return KeptMesh(made, limit)


def _warn_of_cancelled(points: np.ndarray, faces: np.ndarray) -> None:
    """A warning where normals, along which vertices move, cancel; of a mesh with each place once."""
    if (share := share_cancelled(points, faces)) > _CANCELLED:
        log.warning("the mesh's triangles face opposite sides around %.0f %% of its vertices, where normals cancel and "
                    "nothing may move: keep each once and turn them alike (MeshLab: Remove Duplicate Faces, Re-Orient "
                    "all faces coherently), or fuse a new mesh (output='tsdf', --fuse)", 100 * share)


def _fitted(given: Surface, component: np.ndarray, used, observed, device, making: MeshOptions, least_views: int,
            exact: bool, at: Callable) -> tuple[Collapsed, np.ndarray, Faults, str]:
    """The given mesh split and simplified as the depth maps show detail, and where its vertices are, but for a last
    solve; what is wrong with the triangles before they become fewer; KeptMesh.limit."""
    cameras, start = [result.camera for result in used], Start(used)
    finest = footprints(given.vertices, cameras, start.noted(each_depth(given, cameras, device)))
    most, planned = mesh_room(cameras, making.memory_mb)
    log.debug("host %s", planned)
    room, limits = most if making.triangles is None else min(most, _FINEST * making.triangles), []
    smaller = ((scale, sent(used, device, scale)) for scale in start.smaller_sizes())
    division, solved, place, faults = fit_mesh(
        given, observed, device, finest, component, tolerance=making.tolerance, detail=making.subdivide or DETAIL,
        least_views=least_views, most=room, least=_FINER * (making.triangles or 0), smaller=smaller, at=at,
        note=limits.append)
    vertices = solved.vertices
    stays = np.arange(len(place)) < division.count
    if making.triangles is None:
        stays &= ~unlike(vertices, division.vertices(given.vertices))
    else:
        stays[:] = False
    tolerance = tolerance_of(making.tolerance, division.faces, solved) if making.triangles is None else np.inf
    simple, left = simplified(device, division, vertices, solved.unit, place, stays, exact=exact,
                              triangles=making.triangles or 0, tolerance=tolerance)
    log.debug("mesh: %d of %d triangles are needed (tolerance %g)", len(simple.faces), len(division.faces), tolerance)
    limit = _limit(making.triangles, len(simple.faces), most, exact, limits)
    return simple, left, faults, limit


class Start:
    """How far off a mesh begins of the depth maps of DepthResults, and at which smaller sizes these move it first."""

    def __init__(self, results: Sequence[Any]):
        self._results, self._beyond, self._count = results, np.zeros(len(_SIZES), np.int64), 0

    def noted(self, drawn: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """The mesh as each view sees it, passed on."""
        for result, depth in zip(self._results, drawn):
            camera, one = result.camera, slice(_EVERY // 2, None, _EVERY)
            before, after = depth[one, one], result.depth[one, one]
            known = (before > 0) & (after > 0) & (result.status[one, one] == REFINED)
            off = np.abs(after[known] / before[known] - 1) * np.sqrt(camera.fx * camera.fy)
            self._beyond += [np.count_nonzero(off * 2 * size > REACH) for size in _SIZES]     # at the next larger size
            self._count += off.size
            yield depth

    def smaller_sizes(self) -> tuple[float, ...]:
        """The sizes that come first, smallest first; none where the start is near."""
        shares = self._beyond / max(self._count, 1)
        if shares[0] < _FAR:
            return ()
        return tuple(size for size, share in zip(_SIZES, shares) if share > _STILL)[::-1]


def _limit(triangles: int | None, number: int, most: int, exact: bool, limits: list[str]) -> str:
    """KeptMesh.limit of a mesh of this `number` of triangles; `limits`: what fit_mesh noted."""
    if triangles is None:
        return limits[-1] if limits else ""
    if abs(number - triangles) <= _NEAR * triangles:
        return ""
    why = "no more edges can be split or collapse"
    if triangles > most:
        why = f"the memory planned for it holds {most}; give it more: --memory, or memory of refine_mesh"
    elif exact and number > triangles:
        why = "given triangles stay for the sake of what sits on them (texture coordinates, materials, values of faces)"
    return f"the mesh has {number} triangles, not {triangles} as requested: {why}"


def _exact(mesh, making: MeshOptions) -> bool:
    """Whether given vertices and sides stay for what sits on faces, or on vertices where no number is requested."""
    of_vertices, of_faces = sits_on(mesh)
    own = of_vertices - {"colors"} if making.color else of_vertices
    return of_faces or (bool(own) and making.tolerance is None and making.triangles is None)


def _least_views(config: Config) -> int:
    return max(1, config.fusion.agree_views) + 1


def mesh_room(cameras, memory_mb: float | None) -> tuple[int, str]:
    """How many triangles there is room for while the mesh of these views is made, in `memory_mb` of host memory, or a
    share of what is free, at most what all pixels could show; and the plan in a sentence."""
    megabytes, why = memory_mb, "as given"
    if megabytes is None:
        pixels = sum(camera.size.pixels for camera in cameras)
        megabytes = min(_SHARE * available_mb(), 1e-6 * TRIANGLE_BYTES * _PER_PIXEL * pixels)
        why = "at most half of what is free"
    most = int(megabytes * 1e6 / TRIANGLE_BYTES)
    return most, f"memory for the mesh: {megabytes:,.0f} MB ({why}), room for {most:,} triangles while it is made"


def polished(surface: Surface, results, config: Config, device) -> Surface:
    """A fused mesh with its vertices where the depth maps agree; unchanged where there is no room, or no deviations."""
    try:
        solved = solve_mesh(surface, Observations(results), device, rounds=_POLISH,
                            least_views=_least_views(config))
    except (DeviceMemoryError, InputError) as error:      # InputError: results that were kept without their deviations
        log.warning("the fused mesh is complete, but its last smoothing step failed: %s", error)
        return surface
    return replace(surface, vertices=solved.vertices,
                   attributes={"deviation": solved.deviation, "views": solved.seen.astype(np.float64)})


def solve_device(device):
    """The device to solve on: that which `device` means (refine_mesh's), the first of several; an error without one."""
    return comparison_device(device) or open_device(None)


def check_kept(path, mesh, allow_loss: bool = False) -> None:
    """Before the work: raise InputError where the mesh of the file `mesh` would lose what `path` cannot keep, its
    coordinates' digits among it, or where files that belong to others have the names of its materials and textures."""
    path, content = Path(path), read_content(mesh)
    surface = surface_of(mesh, content)
    check_digits(path, surface, ahead=True)
    lost = losses(content, path)
    if lost and not allow_loss:
        raise InputError(f"--keep-mesh would lose of mesh {str(mesh)!r}: {', '.join(lost)}; pass --allow-loss to go on "
                         "without them" + (", or write an .obj file" if lost == ["texture coordinates"] else ""))
    if lost:
        log.warning("%s will not have of %s: %s", path, mesh, ", ".join(lost))
    if path.suffix.lower() == ".obj":
        with tempfile.TemporaryDirectory() as folder:
            write_obj(Path(folder) / path.name, surface)
            taken = differing(Path(folder), path)
        if taken:
            raise InputError(f"--output {str(path)!r}: its materials and textures would replace {taken[0]}, which is "
                             "written by another program; choose another name or folder")
