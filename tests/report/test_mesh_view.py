"""The page that turns two meshes: fewer triangles, distance moved, what is stored, and names that are no HTML."""

import base64
import json
import re
import zlib

import numpy as np
import pytest

from pagas_cl.app.report import mesh_viewer, write_mesh_page
from pagas_cl.app.report.mesh_view import moved_by, simplify


def grid(height, side=60, size=3.0):
    """A square of `size` with 2 side^2 triangles, and `height(x, y)` over it; normals upwards."""
    x, y = np.meshgrid(*2 * [np.linspace(0, size, side + 1)])
    place = np.arange((side + 1) ** 2).reshape(side + 1, -1)
    a, b, c, d = (part.ravel() for part in (place[:-1, :-1], place[:-1, 1:], place[1:, :-1], place[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return np.stack([x, y, height(x, y) + 0 * x], axis=-1).reshape(-1, 3), faces


def roof(x, y):
    return -np.abs(x - 1.55)


def test_a_small_mesh_stays_but_for_vertices_without_a_triangle():
    vertices, faces = grid(roof, 3)
    kept, same = simplify(np.concatenate([[[9, 9, 9]], vertices]), faces + 1, 18)
    assert np.array_equal(kept, vertices) and np.array_equal(same, faces)


@pytest.mark.parametrize("scale, origin", [(1, 0), (1e-4, 0), (1e3, 5e6)])
def test_simplified_meshes_keep_within_the_number_on_the_planes_and_on_the_crease(scale, origin):
    vertices, faces = grid(roof)
    fewer, some = simplify(vertices * scale + origin, faces, 700)
    fewer = (fewer - origin) / scale
    assert 400 < len(some) <= 700 and some.max() == len(fewer) - 1
    assert np.abs(fewer[:, 2] - roof(*fewer.T[:2])).max() < 0.02
    assert fewer[:, 2].max() > -0.01, "the crease is not cut off"
    across = np.cross(*(fewer[some[:, k]] - fewer[some[:, 0]] for k in (1, 2)))
    assert (across[:, 2] > 0).all()


@pytest.mark.parametrize("scale, origin", [(1, 0), (1e-4, 0), (1e3, 5e6)])
def test_moved_by_is_the_signed_distance_from_the_surface(scale, origin):
    vertices, faces = grid(lambda x, y: 0.5 * x, 2)      # eight large triangles
    rng, up = np.random.default_rng(0), np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    on = rng.uniform(0.1, 2.9, (500, 2))
    away = rng.uniform(-0.7, 0.7, 500)
    points = np.column_stack([on, 0.5 * on[:, 0]]) + away[:, None] * up
    found = moved_by(points * scale + origin, vertices * scale + origin, faces) / scale
    assert np.abs(found - away).max() < 1e-5
    off_surface = moved_by(np.array([[3.5, 1.0, 1.75], [1, 1, 900]]) * scale + origin, vertices * scale + origin, faces)
    assert abs(off_surface[0] / scale) == pytest.approx(0.5 * np.sqrt(1.25), rel=0.1) and np.isnan(off_surface[1])


def test_moved_by_of_a_mesh_without_area_is_unknown():
    assert np.isnan(moved_by(np.zeros((2, 3)), np.zeros((3, 3)), [[0, 1, 2]])).all()


def data_of(html):
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', html, re.S)[1])


def test_the_viewer_says_what_it_shows_and_is_the_same_every_time():
    before, after = grid(lambda x, y: 0 * x, 4), grid(lambda x, y: 0.1 * np.sin(3 * x))
    html = mesh_viewer(before, after, most=700)
    assert html == mesh_viewer(before, after, most=700)
    data = data_of(html)
    assert [mesh["of"] for mesh in data["meshes"]] == [32, 7200] and data["meshes"][1]["faces"] <= 700
    assert f"after: 7,200 triangles, {data['meshes'][1]['faces']} of them after simplifying are shown" in html
    assert [value["title"] for value in data["values"]] == ["moved"]
    assert html.count("</script>") == 1 and ">moved</button>" in html and "0.1 scene units along the surface" in html
    assert len(zlib.decompress(base64.b64decode(data["blob"]))) == sum(
        mesh["vertices"] * (6 + 3) + 12 * mesh["faces"] for mesh in data["meshes"]) + data["meshes"][1]["vertices"]


def test_a_mesh_alone_has_no_slider():
    after = grid(roof, 4)
    assert "range" not in mesh_viewer(None, after) and data_of(mesh_viewer(None, after))["values"] == []


def test_the_page_is_one_file_without_a_network(tmp_path):
    page = write_mesh_page(tmp_path / "mesh.html", grid(roof, 4), grid(roof, 5), title="<a>").read_text()
    assert "http" not in page and "src=" not in page and "<title>&lt;a&gt;" in page and "getContext" in page
