"""All that a layer has comes along through the step, or is named before the work."""

import logging
from dataclasses import replace

import numpy as np
import pytest

pymeshlab = pytest.importorskip("pymeshlab")

from PIL import Image  # noqa: E402
from support.scenes import relief_scene  # noqa: E402

from pagas_cl.errors import InputError  # noqa: E402
from pagas_cl.filters.pymeshlab_step import register  # noqa: E402
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE, read_custom, read_layer  # noqa: E402

pytestmark = pytest.mark.slow

FAST = "pyramid.steps=8"
MATRIX = np.array([[0, -0.5, 0, 7.0], [0.5, 0, 0, -3], [0, 0, 0.5, 1 / 3], [0, 0, 0, 1]])


class Meshes(pymeshlab.MeshSet):
    """So that the tests do not change pymeshlab's own class."""


register(Meshes)


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=2, held_out=0, steps=0)


@pytest.fixture
def meshes(made, tmp_path):
    """A layer with a matrix, two textures, quality, colours and custom attributes of every kind; what is on a vertex is
    linear in its place, so that means of it are known."""
    vertices, faces = made.initial_mesh(6.0)
    local = np.linalg.solve(MATRIX[:3, :3], (vertices - MATRIX[:3, 3]).T).T
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in local.tolist()]
    uv = (vertices[:, :2] - vertices[:, :2].min(axis=0)) / np.ptp(vertices[:, :2], axis=0)
    rows += [f"vt {u!r} {v!r}" for u, v in uv.tolist()]
    for k, part in enumerate((faces[: len(faces) // 2], faces[len(faces) // 2:])):
        Image.new("RGB", (4, 4), (200 * k, 9, 9)).save(tmp_path / f"skin{k}.png")
        rows += [f"usemtl m{k}", *("f " + " ".join(f"{c}/{c}" for c in face) for face in (part + 1).tolist())]
    (tmp_path / "skin.mtl").write_text("newmtl m0\nmap_Kd skin0.png\nnewmtl m1\nmap_Kd skin1.png\n")
    (tmp_path / "wall.obj").write_text("mtllib skin.mtl\n" + "\n".join(rows) + "\n")
    meshes = Meshes()
    meshes.load_new_mesh(str(tmp_path / "wall.obj"))
    meshes.compute_scalar_by_function_per_vertex(q="x+3")
    meshes.compute_scalar_by_function_per_face(q="fi+1")
    meshes.compute_color_by_function_per_face(r="fi/10", g="7", b="9", a="255")
    layer = meshes.current_mesh()
    places = layer.vertex_matrix()
    layer.add_vertex_custom_scalar_attribute(places[:, 0] * 2 + 1, "age")
    layer.add_vertex_custom_point_attribute(places * 3, "flow")
    layer.add_face_custom_scalar_attribute(np.arange(layer.face_number(), dtype=float), "part")
    layer.add_face_custom_point_attribute(np.repeat(np.arange(layer.face_number(), dtype=float)[:, None], 3, 1), "tag")
    meshes.set_matrix(transformmatrix=MATRIX, freeze=False)
    meshes.clear_filter_script()
    return meshes


def carried(meshes, folder):
    layer = read_layer(meshes, folder)
    return replace(layer, vertex={**layer.vertex, **layer.custom["vertex"]},
                   face={**layer.face, **layer.custom["face"]}), read_custom(meshes)[0]


def test_a_refined_layer_has_all_that_the_given_one_has(meshes, made, tmp_path, caplog):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    old, old_custom = carried(meshes, tmp_path / "a")
    with caplog.at_level(logging.INFO):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2)
    new, custom = carried(meshes, tmp_path / "b")
    assert "lost" not in caplog.text and CONFIDENCE in caplog.text
    assert set(new.vertex) == {*old.vertex, CONFIDENCE, "deviation", "views"} and set(new.face) == set(old.face)
    assert new.comments == old.comments and len(meshes.current_mesh().textures()) == 2
    parent = custom["face"]["part"].astype(int)                 # of which face each was made
    assert len(parent) > len(old.face["part"])
    for name in ("texnumber", "red", "quality", "tag"):
        assert np.array_equal(new.face[name], old.face[name][parent]), name
    # means of what is linear in the place, where vertices were before they moved: in the picture plane
    u, age = new.vertex["quality"], custom["vertex"]["age"]
    assert np.abs((u - 3) * 2 + 1 - age).max() < 1e-9
    assert np.abs(custom["vertex"]["flow"][:, 0] * 2 / 3 + 1 - age).max() < 1e-9
    count = len(old.vertex["x"])
    assert np.array_equal(age[:count], old_custom["vertex"]["age"])
    corner = new.face["vertex_indices"][:, 0]
    v = new.face["texcoord"][:, 1]                              # of the first corner; linear in local x
    a, b = np.polyfit(age[corner], v, 1)
    assert np.abs(a * age[corner] + b - v).max() < 1e-4
    assert 0 <= custom["vertex"][CONFIDENCE].min() < custom["vertex"][CONFIDENCE].max() <= 1
    saved = tmp_path / "saved"
    saved.mkdir()
    meshes.save_current_mesh(str(saved / "x.obj"))               # the images are the layer's own by now
    assert {file.name for file in saved.iterdir()} >= {"skin0.png", "skin1.png"}


def test_quality_gets_the_confidence_only_where_there_is_none(meshes, made):
    meshes.compute_scalar_by_function_per_vertex(q="0")
    meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2)
    assert CONFIDENCE not in read_custom(meshes)[0]["vertex"]
    assert 0 < meshes.current_mesh().vertex_scalar_array().max() <= 1


def test_a_displaced_layer_keeps_its_quality_twice(meshes, made):
    quality = meshes.current_mesh().vertex_scalar_array()
    values = []
    for _ in range(2):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2, output="displace")
        assert np.array_equal(meshes.current_mesh().vertex_scalar_array(), quality)
        values.append(read_custom(meshes)[0]["vertex"][CONFIDENCE])
    assert values[0].max() > 0 and values[0].shape == values[1].shape
    assert set(read_custom(meshes)[0]["vertex"]) == {"age", "flow", CONFIDENCE}     # none of those that moved values


@pytest.mark.parametrize("arguments, named", [
    ({"output": "tsdf", "voxel": 2.0}, ("'age'", "'flow'", "'part'", "'tag'", "texture coordinates", "face colours",
                                        "vertex quality", "face quality")),
    ({"output": "displace", "subdivide": 1.5}, ("'age'", "'flow'", "'part'", "'tag'")),
])
def test_what_is_lost_is_named_before_the_work(meshes, made, caplog, arguments, named):
    lines = []
    with caplog.at_level(logging.WARNING):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2, **arguments,
                                            progress=lambda stage, done, total: lines.append(caplog.text))
    assert all(word in lines[0] for word in ("not kept", *named)), lines[0]


def test_names_that_pymeshlab_lists_otherwise(made, caplog):
    """It lists names in small letters: those that its filters were given are known, others are named as lost."""
    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(*made.initial_mesh(6.0)), "wall")
    meshes.compute_new_custom_scalar_attribute_per_vertex(name="scalar_Height", expr="z")
    meshes.current_mesh().add_vertex_custom_scalar_attribute(np.zeros(meshes.current_mesh().vertex_number()), "Age")
    with caplog.at_level(logging.WARNING):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2)
    assert "custom attribute 'age'" in caplog.text and "scalar_height" not in caplog.text
    assert meshes.current_mesh().vertex_custom_scalar_attribute_array("scalar_Height").any()


def test_a_name_that_stops_expressions_is_refused_before_the_work(made):
    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(*made.initial_mesh(6.0)), "wall")
    meshes.current_mesh().add_vertex_custom_scalar_attribute(np.zeros(meshes.current_mesh().vertex_number()), "a-b c")
    before = meshes.current_mesh().vertex_matrix()
    with pytest.raises(InputError, match="other characters than letters"):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, output="displace")
    assert np.array_equal(meshes.current_mesh().vertex_matrix(), before)


def test_a_copied_layer_with_attributes_does_not_end_the_process(made):
    """pymeshlab crashes where it writes the attributes of a mesh that add_mesh has copied: the step writes none."""
    mesh = pymeshlab.Mesh(*made.initial_mesh(6.0))
    mesh.add_vertex_custom_scalar_attribute(np.arange(mesh.vertex_number(), dtype=float), "age")
    meshes = Meshes()
    meshes.add_mesh(mesh, "wall")
    meshes.apply_pagas_depth_refinement(made.views, settings=FAST, context_views=2)
    age = meshes.current_mesh().vertex_custom_scalar_attribute_array("age")
    assert np.array_equal(age[:mesh.vertex_number()], np.arange(mesh.vertex_number()))


def test_refine_mesh_carries_a_pymeshlab_mesh_likewise(made):
    import pagas_cl

    mesh = pymeshlab.Mesh(*made.initial_mesh(6.0), v_scalar_array=np.arange(1.0, len(made.initial_mesh(6.0)[0]) + 1))
    mesh.add_vertex_custom_scalar_attribute(mesh.vertex_matrix()[:, 0].copy(), "age")
    mesh.add_face_custom_scalar_attribute(np.arange(mesh.face_number(), dtype=float), "part")
    fine = pagas_cl.refine_mesh(mesh, made.cameras[:3], [view.image for view in made.views], preset="fast")
    count = mesh.vertex_number()
    assert np.array_equal(fine.vertex_scalar_array()[:count], mesh.vertex_scalar_array())
    assert np.array_equal(fine.vertex_custom_scalar_attribute_array("age")[:count], mesh.vertex_matrix()[:, 0])
    assert set(fine.face_custom_scalar_attribute_array("part")) == set(range(mesh.face_number()))
    assert fine.vertex_custom_scalar_attribute_array(CONFIDENCE).max() > 0
