"""Fewer triangles: as many as requested, or as the tolerance leaves; where the surface bends; everything that sits on
the mesh stays."""

import numpy as np
import pytest
from twins import mesh_collapse as twin

from pagas_cl.method.surface import mesh_collapse
from pagas_cl.method.surface.mesh_collapse import simplified
from pagas_cl.method.surface.subdivide import subdivide
from pagas_cl.runtime.memory import download
from pagas_cl.scene.mesh import Surface, grid_faces, triangle_normals

pytestmark = pytest.mark.kernels


def sheet(count=41):
    """Flat but for one fold along x = 20, edges of 1."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(count)))
    return Surface(np.stack([x, y, 0.5 * np.abs(x - 20.0)], axis=1), grid_faces(count, count))


def ball(radius=10.0):
    """A closed surface with edges of about 1."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = np.array([[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)])
    division = subdivide(corners, faces, np.full(6, 0.08))
    points = division.vertices(corners)
    return Surface(radius * points / np.linalg.norm(points, axis=1)[:, None], division.faces)


def whole(surface):
    """A division that splits nothing."""
    return subdivide(surface.vertices, surface.faces, np.full(len(surface.vertices), np.inf))


def made_simple(device, surface, division=None, kept=None, unit=1.0, exact=False, **limit):
    division = division or whole(surface)
    vertices, count = division.vertices(surface.vertices), len(division.vertices(surface.vertices))
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    kept = np.zeros(count, bool) if kept is None else kept
    simple, points = simplified(device, division, vertices, np.full(count, unit), place.reshape(-1).astype(np.int32),
                                kept, exact=exact, **limit)
    return points, simple


def edges_of(faces):
    """How often each edge is there."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


def rough_sheet():
    """Positions, footprints, faces and their wedges of a rough sheet with a seam across."""
    flat, faces = sheet(21).vertices, sheet(21).faces
    points = (0.02 * (flat + np.random.default_rng(1).normal(scale=0.2, size=flat.shape))).astype(np.float32)
    wedges = faces + len(points) * (flat[faces, 1].mean(axis=1) > 10)[:, None]
    unit = np.random.default_rng(2).uniform(0.005, 0.01, len(points)).astype(np.float32)
    return points, unit, faces, wedges


def test_costs_are_those_of_plain_loops(device):
    """The neighbour of least cost, and that cost."""
    points, unit, faces, wedges = rough_sheet()
    work = mesh_collapse._Collapsing(device, points, unit, faces, wedges, np.zeros(len(points), np.uint8))
    work._run("choose", most=1e30)
    target = download(device, work.known["target"], len(points), np.int32)
    cost = download(device, work.known["cost"], len(points))
    work.release()
    expected = twin.choose(points.astype(float), unit.astype(float), faces, wedges)
    assert sum(map(bool, expected)) > 400
    for found, price, costs in zip(target, cost, expected):
        assert (found >= 0) == bool(costs)
        if costs:
            assert price == pytest.approx(min(costs.values()), rel=1e-3) == pytest.approx(costs[found], rel=2e-3)


def test_what_others_collapsed_into_goes_where_plain_loops_say(device):
    """After one round: to where the quadric of both is least, no two neighbours, nothing on the border or the seam."""
    points, unit, faces, wedges = rough_sheet()
    work = mesh_collapse._Collapsing(device, points, unit, faces, wedges, np.zeros(len(points), np.uint8))
    work.run(0, 1e30)
    _, left = work.listed_faces()
    after = download(device, work.known["positions"], (len(points), 3))
    state = download(device, work.known["state"], len(points), np.uint8)
    into = download(device, work.known["next"], len(points), np.int32)
    work.release()
    matrices, _, seams = twin.quadrics(points.astype(float), unit.astype(float), faces, wedges)
    moved = np.flatnonzero((after != points).any(axis=1))
    assert len(moved) > 10 and (state[moved] == mesh_collapse._FREE).all()
    assert not set(moved) & {v for edge in seams for v in edge}
    for v in moved:
        d = (points[v] - points[into[v]]).astype(float)
        expected = twin.to_least(matrices[v] + twin.around_there(matrices[into[v]], d))
        assert after[v] - points[v] == pytest.approx(expected, abs=2e-3 * np.linalg.norm(expected))
    assert np.isin(left % len(points), moved).sum(axis=1).max() == 1


def test_fewer_triangles_lie_nearer_where_vertices_move(device):
    surface, off = ball(), []
    for state in (mesh_collapse._FREE, mesh_collapse._PINNED):
        faces, count = surface.faces, len(surface.vertices)
        numbers, left, points = mesh_collapse.collapse(device, surface.vertices, np.ones(count), faces, faces,
                                                       np.full(count, state, np.uint8), triangles=len(faces) // 10)
        assert np.array_equal(points, surface.vertices.astype(np.float32)) == (state == mesh_collapse._PINNED)
        middles = points[left].mean(axis=1)
        off.append(np.sqrt(np.mean((np.linalg.norm(middles, axis=1) - 10) ** 2)))
    assert off[0] < 0.6 * off[1]


@pytest.mark.parametrize("make", [sheet, ball])
@pytest.mark.parametrize("share", [0.5, 0.1])
def test_so_many_triangles_as_requested(device, make, share):
    surface = make()
    number = int(share * len(surface.faces))
    points, simple = made_simple(device, surface, triangles=number)
    assert abs(len(simple.faces) - number) <= 0.02 * number
    ends, times = edges_of(simple.faces)
    assert times.max() == 2 and len(np.unique(simple.faces)) == len(points)
    border = points[ends[times == 1]]
    if make is ball:
        assert not len(border) and len(points) - len(ends) + len(simple.faces) == 2      # a sphere still
        assert np.linalg.norm(points[simple.faces].mean(axis=1), axis=1).min() > 10 - (0.2 if share == 0.5 else 0.7)
    else:
        assert len(points) - len(ends) + len(simple.faces) == 1                          # a disc still
        assert np.isin(border[:, :, :2], (0, 40)).any(axis=2).all()


def test_flat_parts_take_few_triangles_and_edges_lie_along_the_fold(device):
    points, simple = made_simple(device, sheet(), tolerance=0.01)
    assert len(simple.faces) < 200
    assert np.array_equal(points, sheet().vertices[simple.keep])      # nothing moves on planes, bit for bit
    normals = triangle_normals(points, simple.faces)
    slope = normals[:, 0] / normals[:, 2]
    assert np.allclose(np.abs(slope), 0.5, atol=1e-6)      # no triangle lies across the fold
    area = np.linalg.norm(normals, axis=1).sum() / 2
    assert area == pytest.approx(40 * 40 * np.sqrt(1.25), rel=1e-6)


@pytest.mark.parametrize("tolerance", [0.05, 0.2])
def test_nothing_is_farther_off_than_the_tolerance_says(device, tolerance):
    surface = ball()
    points, simple = made_simple(device, surface, unit=0.5, tolerance=tolerance)
    middles = np.linalg.norm(points[simple.faces].mean(axis=1), axis=1)
    assert len(simple.faces) < 0.8 * len(surface.faces) and np.sqrt(np.mean((middles - 10) ** 2)) < tolerance


def test_the_same_bits_twice_in_any_unit_and_anywhere(device):
    surface = sheet()
    rough = surface.vertices + np.random.default_rng(3).normal(scale=0.05, size=surface.vertices.shape)
    one, again = (made_simple(device, Surface(rough, surface.faces), triangles=900) for _ in range(2))
    assert np.array_equal(one[0], again[0]) and np.array_equal(one[1].faces, again[1].faces)
    for factor, shift in ((1024.0, 0.0), (1.0, 2.0**20)):
        moved = Surface(factor * rough + shift, surface.faces)
        _, simple = made_simple(device, moved, unit=factor, triangles=900)
        same = np.isin(simple.keep, one[1].keep).mean()
        assert same == 1.0 if shift == 0 else same > 0.95      # costs that are nearly equal


def test_vertices_that_are_kept_stay(device):
    surface = sheet()
    kept = surface.vertices[:, 0] < 10
    points, simple = made_simple(device, surface, kept=kept, tolerance=0.05)
    assert np.isin(np.flatnonzero(kept), simple.keep).all()
    assert len(points) < kept.sum() + 100


@pytest.mark.parametrize("number", [1200, 400])
def test_a_seam_stays_closed(device, number):
    """Two halves that share no vertex: where they meet, both have the same vertices left."""
    surface = sheet()
    count, upper = len(surface.vertices), surface.vertices[surface.faces, 1].mean(axis=1) > 20
    half, rest = surface.faces[~upper], surface.faces[upper]
    doubled = Surface(np.concatenate([surface.vertices] * 2), np.concatenate([half, rest + count]))
    points, simple = made_simple(device, doubled, triangles=number)
    used = points[np.unique(simple.faces)]
    places, at = np.unique(used, axis=0, return_inverse=True)
    number_of = np.full(len(points), -1)
    number_of[np.unique(simple.faces)] = at.reshape(-1)
    ends, times = edges_of(number_of[simple.faces])
    border = places[ends[times == 1]]
    assert abs(len(simple.faces) - number) <= 0.02 * number
    assert len(places) < len(used) and np.isin(border[:, :, :2], (0, 40)).any(axis=2).all()
    upper = simple.keep[simple.faces] >= count
    assert (upper.all(axis=1) | ~upper.any(axis=1)).all()      # no triangle has corners of both


def test_coordinates_in_an_image_are_exact(device):
    """Each given triangle has coordinates of its own, by another map: what is left of it has those of that map."""
    rng = np.random.default_rng(0)
    given = Surface(5.0 * sheet(5).vertices, sheet(5).faces)
    division = subdivide(given.vertices, given.faces, np.full(len(given.vertices), 0.6))
    coordinates = rng.uniform(size=(len(given.faces), 3, 2))
    points, simple = made_simple(device, given, division, exact=True, tolerance=0.05)
    assert len(given.faces) <= len(simple.faces) < 0.3 * len(division.faces)
    carried = simple.corners(coordinates)
    for face, parent, uv in zip(simple.faces, simple.parents, carried):
        corners = given.vertices[given.faces[parent]]
        weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]),
                                  np.vstack([points[face].T, np.ones(3)]), rcond=None)[0]
        assert np.allclose(weights.T @ coordinates[parent], uv, atol=1e-9)
    assert np.array_equal(simple.on_faces(np.arange(len(given.faces))), simple.parents)
    assert np.allclose(simple.vertices(given.vertices), points)


def test_a_mesh_of_loose_and_empty_triangles_is_left_alone(device):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 2, 2.0]])
    surface = Surface(points, np.array([[0, 1, 2], [3, 3, 3], [0, 0, 1]]))
    left, simple = made_simple(device, surface, tolerance=1e-3)
    assert np.array_equal(left, points) and np.array_equal(simple.faces, surface.faces)
