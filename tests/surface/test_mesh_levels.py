"""Splitting edges level by level: what is split with an edge, and what a vertex or an edge of many triangles costs."""

import tracemalloc

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.method.surface import mesh_levels
from pagas_cl.method.surface.mesh_evidence import Observed
from pagas_cl.method.surface.mesh_levels import TRIANGLE_BYTES, fit_mesh
from pagas_cl.method.surface.mesh_solve import Solved
from pagas_cl.method.surface.on_vertices import footprints
from pagas_cl.method.surface.weld import component_of, welded
from pagas_cl.scene.mesh import Surface, grid_faces


def fan(count, radius=40.0, growth=0.0):
    """`count` triangles around one vertex; with `growth` each of its edges is longer than the one before."""
    angle = 2 * np.pi / count * np.arange(count)
    reach = radius * (1 + growth * np.arange(count) / count)
    rim = np.stack([reach * np.cos(angle), reach * np.sin(angle), 0 * angle], axis=1)
    k = np.arange(count)
    return Surface(np.concatenate([[[0, 0, 0.0]], rim]), np.stack([0 * k, 1 + k, 1 + (k + 1) % count], axis=1))


def book(count, height=40.0):
    """`count` triangles on one edge."""
    angle = np.linspace(0, np.pi, count)
    tips = np.stack([height * np.cos(angle), 0 * angle, -height * np.sin(angle)], axis=1)
    k = np.arange(count)
    spine = [[0, -height, 0], [0, height, 0]]
    return Surface(np.concatenate([spine, tips]), np.stack([0 * k, 0 * k + 1, 2 + k], axis=1))


def uneven(count):
    """A sheet of count x count vertices, none of its edges as long as another."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(count)))
    points = np.stack([x, y, 0 * x], axis=1) + np.random.default_rng(5).uniform(-0.3, 0.3, (count * count, 3))
    return Surface(10 * points, grid_faces(count, count))


class Counted(np.ndarray):
    """An array that counts how many of its items are looked up."""

    looked_up = 0

    def __getitem__(self, item):
        Counted.looked_up += np.size(item)
        return np.asarray(self)[item]


def split_once(surface, most, device):
    """A level of splitting, as fit_mesh does it: the mesh, the numbers of the edges that were split, by loops and as it
    does it, and the peak of the memory that it takes."""
    mesh = mesh_levels._Splitting(surface, np.ones(len(surface.vertices)))
    lengths, ends = mesh.edges.lengths(mesh.points), mesh.edges.ends.copy()
    long = np.flatnonzero(lengths > 1.5)
    off = np.random.default_rng(1).uniform(0, 1, len(long)).astype(np.float32)
    wanted, sides = off > 0.7, mesh.edges.sides.T.tolist()
    tracemalloc.start()
    done = mesh.split_longest_with(device, long, wanted, off, lengths, most)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    farthest = long[wanted][np.argsort(-off[wanted])][:done]
    split = np.flatnonzero((mesh.edges.ends[:len(ends)] != ends).any(axis=1))
    return mesh, with_longest(farthest, sides, lengths), split, peak


def with_longest(first, sides, lengths):
    """By plain loops: these edges, and the longest of each face that has one of them."""
    split, before, length = set(first.tolist()), -1, lengths.astype(np.float32)
    while len(split) > before:
        before = len(split)
        split |= {max(face, key=lambda edge: length[edge]) for face in sides if split & set(face)}
    return sorted(split)


@pytest.mark.parametrize("surface", [uneven(12), fan(40), fan(40, growth=1.0), book(40)],
                         ids=["sheet", "fan", "growing fan", "book"])
@pytest.mark.parametrize("most", [10**6, 30])
def test_with_an_edge_the_longest_of_each_of_its_faces_is_split(surface, most, device):
    mesh, expected, split, _ = split_once(surface, len(surface.faces) + most, device)
    assert split.tolist() == expected and len(mesh.edges) <= len(surface.faces) + most
    assert len(split) or most < len(surface.faces)      # fewer may be made than any edge takes along


@pytest.mark.parametrize("make", [fan, lambda count: fan(count, growth=1.0), book], ids=["fan", "growing fan", "book"])
@pytest.mark.parametrize("count", [100, 1000, 3000])
def test_many_faces_on_a_vertex_or_an_edge_cost_their_share(make, count, monkeypatch, device):
    """Each side of a triangle is looked at once, and memory is that of any mesh of as many triangles."""
    surface, plain = make(count), mesh_levels._with_longest
    split_once(make(10), 10**6, device)         # what is compiled and imported once counts for no mesh
    monkeypatch.setattr(mesh_levels, "_with_longest", lambda first, begin, longest_around: plain(
        first, begin, longest_around.view(Counted)))
    Counted.looked_up = 0
    mesh, _, split, peak = split_once(surface, 10**6, device)
    assert len(split) > count / 4 and Counted.looked_up <= 3 * count
    assert peak < TRIANGLE_BYTES * len(mesh.edges)


@pytest.mark.parametrize("make", [fan, lambda count: fan(count, growth=1.0)], ids=["fan", "growing fan"])
@pytest.mark.parametrize("detail", [1.5, 0.5])
def test_slivers_get_no_more_triangles_than_depth_maps_can_show(make, detail):
    """What there is room for goes with the area that views see, whatever the triangles' shape or number."""
    def room(surface, unit=1.0):
        mesh = mesh_levels._Splitting(surface, np.full(len(surface.vertices), unit))
        return mesh.most_shown(detail) - len(mesh.edges)

    assert room(make(3000)) == pytest.approx(room(make(100)), rel=0.03)
    assert room(make(100), np.inf) == 0
    assert room(uneven(12)) == pytest.approx(mesh_levels._DENSEST / detail**2 * 110**2, rel=0.1)


@pytest.mark.parametrize("surest, deviation, expected", [
    (0.5, 0.02, mesh_levels.TOLERANCE), (0.5, 0.5, 0.1), (0.26, 0.02, mesh_levels.TOLERANCE), (0.2, 0.02, 0.15)])
@pytest.mark.parametrize("scale", [1, 1e-30])
def test_triangles_are_no_smaller_than_the_surest_quarter_is_sure(surest, deviation, expected, scale):
    """`surest` of the surface is unsure by `deviation`, the rest by 4, of footprints of 2; the unseen says nothing; in
    any unit."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(101), np.arange(11)))
    sheet, faces = np.stack([x, y, 0 * x], axis=1).astype(float), grid_faces(101, 11)
    points, faces = np.concatenate([sheet, sheet + (0, 0, 50)]), np.concatenate([faces, faces + len(sheet)])
    off = np.where(points[:, 0] <= 100 * surest, deviation, 4.0)
    off[len(sheet):] = np.inf
    solved = Solved(scale * points, np.zeros(len(points), int), scale * off,
                    np.full(len(points), 2 * scale, np.float32))
    assert mesh_levels.tolerance_of(None, faces, solved) == pytest.approx(expected)
    assert mesh_levels.tolerance_of(0.07, faces, solved) == 0.07
    solved.deviation[:] = np.inf
    assert mesh_levels.tolerance_of(None, faces, solved) == mesh_levels.TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("make, count", [(fan, 100), (fan, 3000), (book, 40), (book, 100)])
def test_a_mesh_of_many_faces_on_a_vertex_is_fitted_within_its_memory(make, count, device):
    made, most = relief_scene(96, 72, contexts=3, held_out=0), 30_000
    views = [Observed(camera, made.true_depth(camera).astype(np.float32),
                      np.full((camera.height, camera.width), 0.1 * made.relief.parallax, np.float32))
             for camera in made.cameras[:4]]
    surface = make(count, 40 * made.relief.footprint)
    size = footprints(surface.vertices, [view.camera for view in views], [view.depth for view in views])
    tracemalloc.start()
    component = component_of(welded(surface.vertices)[1], surface.faces)
    division, solved, *_ = fit_mesh(surface, views, device, size, component, most=most)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count < len(division.faces) <= most and np.isfinite(solved.vertices).all()
    assert peak < TRIANGLE_BYTES * most
