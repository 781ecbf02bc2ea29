"""No faults that were not there (method section 10.5): where triangles cross, turned over or have no area and had not
before the mesh was moved, vertices are displaced as their neighbours are instead, or less far."""

from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.method.surface.mesh_faults import CROSSING, FLAT, FOLDED, TURNED, FaultSearch, MovingVertices, faults
from pagas_cl.method.surface.mesh_rings import rings_of
from pagas_cl.method.surface.raster import Frame, frame_of
from pagas_cl.method.surface.subdivide import Subdivision
from pagas_cl.method.surface.weld import at_a_corner, welded
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import release
from pagas_cl.scene.mesh import Surface

# Constants of section 10.5.
_RING_PASSES = 3           # times that displacements of new faults become the mean of their neighbours',
_MOST_RINGS = 4            # then with a ring of vertices more around them, up to so many
_RINGS = 6                 # around new faults that are looked at meanwhile
_TRIES = (False, True, True, True)      # whether displacements are halved instead, one try after the other


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

    def then(self, later: "Faults") -> "Faults":
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
                component: np.ndarray, start: np.ndarray | None = None,
                place: np.ndarray | None = None) -> tuple[np.ndarray, Faults]:
    """Where the vertices (V', 3) of a mesh, split as `division` says, are to be so that it has no fault that `given`
    had not: corners of such triangles are displaced as their neighbours are, from where they were given or from `start`
    (V', 3); and the faults. What is near triangles that had faults, or a component that stood in others, is let alone.
    `component` (V,): weld.component_of; `place` (V',): which vertices are at one place, found where not given."""
    before, faces = given.vertices, given.faces
    if division is not None:
        before, faces = division.vertices(before), division.faces
    place = welded(before)[1] if place is None else place
    count = int(place.max()) + 1
    one = np.empty(count, np.int64)                        # a vertex at each place: those at one place stay together
    one[place] = np.arange(len(place))
    before, end = np.take(before, one, axis=0), np.take(vertices, one, axis=0)
    start = before if start is None else np.take(start, one, axis=0)
    given_faces, faces = place[given.faces], place[faces]
    frame = frame_of(Surface(start, faces))      # one for all: what is rounded is rounded alike each time
    own, component = component, (component if division is None else division.vertices(component))[one]
    with translate_cl_errors(device, "looking for triangles that cross"):
        old = faults(device, before, before, given_faces, component, frame)
        tolerated = _near_old(device, before, given, faces, division, component, old, frame)
        stood_in = own[given.faces[(old & CROSSING) > 0, 0]]   # components that crossed others
        tolerated |= np.where(np.isin(component[faces[:, 0]], stood_in), CROSSING, 0)
        moving = MovingVertices(device, start, component, frame)
        order = moving.in_order(faces)
        faces, tolerated = np.take(faces, order, axis=0), tolerated[order]
        search = FaultSearch(moving, faces)
        if start is not before:
            tolerated |= search.run(start)
        found = search.run(end)
        for halved in _TRIES:
            search.tolerate(tolerated)
            some = search.around(_RINGS)
            if not len(some):
                break
            tolerated[some] |= faults(device, before, before, faces[some], component, frame)
            moving.rings = moving.rings or rings_of(device, search.known["faces"], len(faces), count)
            _mend(moving, faces[some], found[some], tolerated[some], halved)
            search.look()
            found = search.found()
        mended, places = moving.displaced(start)
        end[mended] = places
        release(search, moving)
    crossing, vertices, there = CROSSING | FOLDED, vertices.copy(), np.isin(place, mended)
    vertices[there] = end[place[there]]
    return vertices, Faults(
        given=len(old), crossed=_count(old, crossing), had_no_area=_count(old, FLAT), count=len(found),
        crossing=_count(found, crossing), no_area=_count(found, FLAT), turned=_count(found, TURNED),
        new=_count(found & ~tolerated, crossing), mended=len(mended))


def _near_old(device: Device, start: np.ndarray, given: Surface, faces: np.ndarray,
              division: Subdivision | None, component: np.ndarray, old: np.ndarray, frame: Frame) -> np.ndarray:
    """Faults (F',) that the faces may have since they, split alike, or faces around them had them at `start`."""
    wrong = np.zeros(len(given.vertices), bool)
    wrong[given.faces[(old & ~CROSSING) > 0]] = True
    there = at_a_corner(wrong, given.faces)
    some = np.flatnonzero(there if division is None else there[division.parents])
    near, corners = faces[some], np.zeros(len(start), bool)
    corners[near[(faults(device, start, start, near, component, frame) & ~CROSSING) > 0]] = True
    corners[faces[at_a_corner(corners, faces)]] = True      # and a ring around them
    return np.where(at_a_corner(corners, faces), np.int32(~CROSSING), np.int32(0))


def _mend(moving: MovingVertices, faces: np.ndarray, found: np.ndarray, tolerated: np.ndarray, halved: bool) -> None:
    """Displace vertices until no face has a fault that is not `tolerated`, farther and farther around `found` ones."""
    for rings in range(_MOST_RINGS + 1):
        search = FaultSearch(moving, faces, found, tolerated)
        for _ in range(_RING_PASSES):
            if not search.mark(rings):
                break
            moving.displace(1 if halved else rings + 1, halved)
            search.look(moved="marked")
        near, found = search.around(_RINGS), search.found()
        search.release()
        if not len(near):
            break
        faces, found, tolerated = faces[near], found[near], tolerated[near]


def _count(found: np.ndarray, fault: int) -> int:
    return int(np.count_nonzero(found & fault))
