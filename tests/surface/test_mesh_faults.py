"""Triangles that cross, turned over or have no area: found as the twin finds them, and mended where they are new."""

import re

import numpy as np
import pytest
from twins import mesh_faults as twin

from pagas_cl.method.surface.mesh_faults import (
    CROSSING,
    FLAT,
    FOLDED,
    TURNED,
    FaultSearch,
    MovingVertices,
    faults,
)
from pagas_cl.method.surface.mesh_mending import without_new
from pagas_cl.method.surface.mesh_rings import rings_of
from pagas_cl.method.surface.raster import Frame, frame_of
from pagas_cl.method.surface.subdivide import subdivide
from pagas_cl.method.surface.weld import component_of, welded
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.mesh import Surface

pytestmark = pytest.mark.kernels

FRAME = Frame(np.full(3, 0.5), 2.0)       # of what lies within the unit cube
SHEET = Frame(np.array([6.0, 6.0, 0.0]), 20.0)


def soup(count, spread):
    """Triangles of all sizes, some of which share corners or sides."""
    rng = np.random.default_rng(3)
    middle, size = rng.uniform(size=(count, 1, 3)), 10 ** rng.uniform(-spread, -0.5, (count, 1, 1))
    points = (middle + size * rng.normal(size=(count, 3, 3))).reshape(-1, 3)
    faces = np.arange(3 * count).reshape(-1, 3)
    faces[1::4, 0], faces[2::4, :2] = faces[::4, 0], faces[::4, 1:]
    return points, faces.astype(np.int32)


def sheet():
    """Squares of two triangles in a plane, 13 by 13 vertices."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(13.0), np.arange(13.0)))
    grid = np.arange(13 * 13, dtype=np.int32).reshape(13, 13)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]))
    return np.stack([x, y, 0 * x], axis=1), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


@pytest.mark.parametrize("spread", [0.6, 2.5])
def test_faults_are_those_of_the_twin(device, spread):
    points, faces = soup(120, spread)
    points[faces[5, 2]] = points[faces[5, 0]]                            # no area
    points[faces[13]], faces = points[faces[13, 0]], np.concatenate([faces, faces[[13]]])      # a point, twice
    before = points.copy()
    before[faces[9, 2]] = 2 * before[faces[9, 0]] - before[faces[9, 2]]      # two corners pass each other
    part = np.arange(len(points), dtype=np.int32)
    found, expected = faults(device, before, points, faces, part, FRAME), twin.faults(before, points, faces)
    assert np.array_equal(found, faults(device, before, points, faces, part, FRAME))
    found = (found > FLAT) * CROSSING | found & (TURNED | FLAT)
    assert np.array_equal(found, expected)
    assert found[5] & FLAT and found[9] & TURNED and found[13] == found[-1] == FLAT
    assert 20 < np.count_nonzero(expected & CROSSING) < len(faces)


def test_what_is_looked_at_again_is_as_if_for_the_first_time(device):
    """And displacements are those of the twin."""
    points, faces = soup(200, 1.5)
    faces = np.append(faces, faces[:, [0, 2, 1]], axis=0)
    rng, part = np.random.default_rng(7), (np.arange(len(points)) % 2).astype(np.int32)
    before = points + rng.normal(0, 0.02, points.shape)
    vertices = MovingVertices(device, before, part, FRAME)
    faces = faces[vertices.in_order(faces)]
    vertices.rings = rings_of(device, upload(device, faces), len(faces), len(points))
    search = FaultSearch(vertices, faces, tolerated=rng.choice([0, CROSSING | FOLDED], len(faces)).astype(np.int32))
    found = search.run(points)
    for halved in (False, True, False):
        number = search.mark(1)
        marked = download(device, vertices.known["marked"], len(points), np.uint8) > 0
        expected = twin.displaced(points, before, faces, marked, halved)
        vertices.displace(1, halved)
        search.look(moved="marked")
        points = download(device, vertices.known["positions"], (len(points), 3)) * FRAME[1] + FRAME[0]
        assert 0 < number < np.count_nonzero(found) and 0 < marked.sum() < len(points)
        assert np.abs(points - expected).max() < 1e-6
        found = search.found()
        assert np.array_equal(found, faults(device, before, points, faces, part, FRAME))
    some, places = vertices.displaced(before)
    assert np.allclose(places, points[some], rtol=0, atol=1e-6) and (len(some) < len(points))


def test_crossing_is_what_meshlab_says(device):
    pymeshlab = pytest.importorskip("pymeshlab")
    points, faces = soup(400, 1.5)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points, faces))
    meshes.compute_selection_by_self_intersections_per_face()
    theirs = meshes.current_mesh().face_selection_array()
    own = faults(device, points, points, faces, np.zeros(len(points), np.int32), FRAME) & FOLDED > 0
    assert theirs.sum() > 100 and (own != theirs).sum() <= 0.01 * theirs.sum()      # own: without what only touches


def test_needles_across_a_mesh_cross_what_the_twin_says(device):
    """Boxes around long triangles hold most of the mesh: their planes and sides count, too."""
    rng = np.random.default_rng(5)
    points, faces = sheet()
    points[:, 2] += rng.uniform(-0.3, 0.3, len(points))
    ends = rng.uniform([0, 0, -1], [12, 12, 1], (90, 2, 3))
    width = 10 ** rng.uniform(-5, 0, (90, 1))
    needles = np.concatenate([ends, ends[:, 1:] + width[:, None] * rng.normal(size=(90, 1, 3))], axis=1)
    needles = needles[np.arange(90)[:, None], (rng.integers(3, size=90)[:, None] + np.arange(3)) % 3]
    faces = np.concatenate([faces, len(points) + np.arange(270).reshape(-1, 3)]).astype(np.int32)
    points = np.concatenate([points, needles.reshape(-1, 3)])
    found = faults(device, points, points, faces, np.arange(len(points), dtype=np.int32), SHEET)
    assert np.array_equal((found & CROSSING) > 0, (twin.faults(points, points, faces) & CROSSING) > 0)
    assert np.count_nonzero(found & CROSSING) > 100


@pytest.mark.parametrize("count", [100, 1000, 3000])
def test_slivers_around_a_vertex_are_searched_as_others_are(device, count):
    """A needle through a flat fan crosses those of its triangles that it goes through, and no others cross."""
    angle = 2 * np.pi / count * np.arange(count)
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    needle = [[0.5, 0.1, -1], [0.51, 0.1, 1], [0.5, 0.12, 1]]
    points, k = np.concatenate([[[0, 0, 0]], rim, needle]), np.arange(count)
    faces = np.concatenate([np.stack([0 * k, 1 + k, 1 + (k + 1) % count], axis=1), [count + 1 + np.arange(3)]])
    part = (np.arange(len(points)) > count).astype(np.int32)
    found = faults(device, points, points, faces.astype(np.int32), part, frame_of(Surface(points, faces)))
    through = np.flatnonzero(found & CROSSING)
    assert through[-1] == count and not (found & FOLDED).any()
    ends = np.arctan2([0.1, 0.11], [0.505, 0.5]) * count / (2 * np.pi)
    assert through[0] == int(ends[0]) and through[-2] == int(ends[1]) and (np.diff(through[:-1]) == 1).all()


@pytest.mark.parametrize("height", [0.01, 0.3, 3.0])
def test_crumpled_fans_cross_what_the_twin_says(device, height):
    """Boxes of triangles that share a corner are looked at by the sides there, wherever in a triangle it is."""
    rng, count = np.random.default_rng(11), 64
    angle = np.sort(rng.uniform(0, 2 * np.pi, (2, count)), axis=1) + rng.normal(0, 0.05, (2, count))
    away = rng.uniform(0.2, 1, (2, count))
    rim = np.stack([away * np.cos(angle), away * np.sin(angle), height * rng.normal(size=(2, count))], axis=2)
    hubs = np.array([[0.0, 0, 0], [1, 0.2, 0.1]])
    points, k = np.concatenate([hubs, (rim + hubs[:, None]).reshape(-1, 3)]), np.arange(count)
    fans = [np.stack([0 * k + hub, 2 + hub * count + k, 2 + hub * count + (k + 1) % count], axis=1) for hub in (0, 1)]
    faces = np.take_along_axis(np.concatenate(fans), (rng.integers(3, size=(2 * count, 1)) + np.arange(3)) % 3, axis=1)
    found = faults(device, points, points, faces.astype(np.int32), np.arange(len(points), dtype=np.int32),
                   frame_of(Surface(points, faces)))
    expected = (twin.faults(points, points, faces) & CROSSING) > 0
    assert np.array_equal((found & (CROSSING | FOLDED)) > 0, expected) and 10 < np.count_nonzero(expected)


def test_new_faults_are_mended_and_said(device):
    """A vertex that went through its neighbours goes with them; what is far from it stays bit for bit, and a wall that
    stood in the sheet may."""
    points, faces = sheet()
    wall = np.array([[2.5, 0.2, -1], [2.5, 11.8, -1], [2.5, 6, 1.0]])
    given = Surface(np.concatenate([points, wall]), np.append(faces, [len(points) + np.arange(3)], axis=0))
    division = subdivide(given.vertices, given.faces, np.full(len(given.vertices), 1.2))
    split = division.vertices(given.vertices)
    lifted = split + [0, 0, 0.3]
    lifted[8 * 13 + 8] += [0.5, 1.7, 0.4]
    vertices, said = without_new(device, given, division, lifted, component_of(welded(given.vertices)[1], given.faces))
    moved = (vertices != lifted).any(axis=1)
    assert 0 < np.count_nonzero(moved) < 30 and moved[8 * 13 + 8]
    assert np.abs(vertices - split - [0, 0, 0.3])[moved].max() < 1
    made, given_ones = map(int, re.match(r"(\d+) of \d+ triangles cross others \((\d+) of 289", str(said)).groups())
    assert made >= 10 and given_ones > 10
    assert "0 of them where none did before; 0 are turned over, 0 have no area (0 before); to avoid them " in str(said)
    assert said.mended == moved.sum() and "vertices moved as their neighbours did" in str(said)
    same, said = without_new(device, given, division, split, component_of(welded(given.vertices)[1], given.faces))
    assert np.array_equal(same, split) and said.mended == 0


def test_sides_that_went_through_each_other_go_back(device):
    """Where neighbours are no help: two sides of one bent sheet, each evenly moved beyond the other."""
    points, faces = sheet()
    column = points[:, 0]
    bent = np.stack([np.minimum(column, 13 - column), points[:, 1], column // 6.5], axis=1)
    moved = bent.copy()
    inside = (abs(bent[:, 0] - 3) < 2) & (abs(bent[:, 1] - 6) < 4)
    moved[inside, 2] = 1 - bent[inside, 2]
    own = np.zeros(len(bent), np.int32)
    vertices, said = without_new(device, Surface(bent, faces), None, moved, own)
    assert faults(device, bent, moved, faces, own, SHEET).any()
    assert not faults(device, bent, vertices, faces, own, SHEET).any()
    assert np.array_equal(vertices[bent[:, 1] < 1], bent[bent[:, 1] < 1]) and said.new == 0


def test_vertices_at_one_place_stay_together(device):
    points, faces = sheet()
    halves = np.array_split(faces, 2)
    given = Surface(np.concatenate([points, points]), np.concatenate([halves[0], halves[1] + len(points)]))
    moved = given.vertices.copy()
    moved[[6 * 13 + 6, len(points) + 6 * 13 + 6]] += [1.6, 0, 0]
    vertices, said = without_new(device, given, None, moved, component_of(welded(given.vertices)[1], given.faces))
    assert said.turned == 0 and (vertices != moved).any()
    assert np.array_equal(vertices[:len(points)], vertices[len(points):])
