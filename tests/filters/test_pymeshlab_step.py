"""The step as a method of MeshSet: signature, history, matrices, colours, quality, textures and attributes."""

import inspect

import numpy as np
import pytest

pymeshlab = pytest.importorskip("pymeshlab")

from support.scenes import relief_scene  # noqa: E402

from pagas_cl.errors import InputError  # noqa: E402
from pagas_cl.filters.history import saved_history  # noqa: E402
from pagas_cl.filters.parameters import PARAMETERS, to_values  # noqa: E402
from pagas_cl.filters.pymeshlab_step import METHOD, register, scene_views  # noqa: E402

pytestmark = pytest.mark.slow

FAST = "pyramid.steps=8"
MATRIX = np.array([[0, -0.5, 0, 7.0], [0.5, 0, 0, -3], [0, 0, 0.5, 1 / 3], [0, 0, 0, 1]])


class Meshes(pymeshlab.MeshSet):
    """So that the tests do not change pymeshlab's own class for each other."""


@pytest.fixture(scope="module", autouse=True)
def registered():
    assert register(Meshes) is Meshes


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=2, held_out=0, steps=0)


def layer(made, tmp_path=None):
    """A layer with a matrix, a texture, colours and an attribute, that lies right in the scene."""
    vertices, faces = made.initial_mesh(3.0)
    local = np.ascontiguousarray(np.linalg.solve(MATRIX[:3, :3], (vertices - MATRIX[:3, 3]).T).T)
    rng = np.random.default_rng(0)
    colors = np.column_stack([rng.integers(0, 256, (len(local), 3)) / 255, np.ones(len(local))])
    meshes = Meshes()
    corners = rng.random((3 * len(faces), 2))
    meshes.add_mesh(pymeshlab.Mesh(local, faces, v_color_matrix=colors, w_tex_coords_matrix=corners,
                                   f_scalar_array=np.arange(len(faces), dtype=float)), "wall")
    meshes.set_matrix(transformmatrix=MATRIX, freeze=False)
    meshes.current_mesh().add_vertex_custom_scalar_attribute(np.arange(len(local), dtype=float), "age")
    if tmp_path is not None:
        from PIL import Image

        Image.new("RGB", (4, 4)).save(tmp_path / "skin.png")
        meshes.set_texture_per_mesh(textname=str(tmp_path / "skin.png"))
    meshes.clear_filter_script()
    return meshes


def test_signature_is_a_real_one():
    signature = inspect.signature(getattr(Meshes, METHOD))
    assert list(signature.parameters)[:3] == ["self", "scene", "preset"]
    assert signature.parameters["output"].default == "mesh" and "pixel" in getattr(Meshes, METHOD).__doc__


def test_register_takes_class_object_or_nothing():
    class Other(pymeshlab.MeshSet):
        pass

    assert register(Other()) is Other and hasattr(Other, METHOD)
    assert register() is pymeshlab.MeshSet and hasattr(pymeshlab.MeshSet(), METHOD)
    delattr(pymeshlab.MeshSet, METHOD)
    with pytest.raises(InputError, match="is no pymeshlab.MeshSet"):
        register(int)


def test_new_layer_has_matrix_colours_quality_and_history(made):
    meshes = layer(made)
    meshes.apply_filter("compute_normal_per_face")
    before = meshes.current_mesh().vertex_matrix()
    counts = meshes.apply_pagas_depth_refinement(made.views, settings=FAST, voxel=2, context_views=2)
    assert counts["refined"] > 500 and set(counts) == {"refined", "kept", "rejected", "no surface"}
    new = meshes.current_mesh()
    assert (meshes.mesh_number(), new.label()) == (2, "wall refined")
    assert np.array_equal(new.transform_matrix(), MATRIX)  # to the last digit
    world = new.transformed_vertex_matrix()
    assert np.abs(world[:, 2]).max() < 80 and np.ptp(world[:, 0]) > 100
    assert np.allclose(np.linalg.norm(new.vertex_normal_matrix(), axis=1), 1)
    quality = new.vertex_scalar_array()
    assert 0 <= quality.min() < quality.max() <= 1
    assert np.ptp(new.vertex_color_matrix()[:, :3]) > 0.2
    assert np.array_equal(meshes.mesh(0).vertex_matrix(), before)  # the given layer is left alone
    steps = saved_history(meshes)
    assert [s.get("name") for s in steps] == ["Re-Compute Face Normals", "PAGaS Depth Refinement"]
    assert {p.get("name"): p.get("value") for p in steps[1]}["contextViews"] == "2"


@pytest.mark.parametrize("subdivide", [0.0, 1.5])
def test_displaced_layer_keeps_all_that_sits_on_it(made, tmp_path, subdivide):
    meshes = layer(made, tmp_path)
    meshes.compute_selection_by_condition_per_face(condselect="fi == 0")      # changes nothing, and stays
    meshes.clear_filter_script()
    old = meshes.current_mesh()
    positions, faces, colors = old.vertex_matrix(), old.face_matrix(), old.vertex_color_matrix()
    corners, matrix = old.wedge_tex_coord_matrix(), old.transform_matrix()
    count = len(positions)
    meshes.apply_pagas_depth_refinement(made.views, settings=FAST, output="displace", subdivide=subdivide)
    new = meshes.current_mesh()
    assert meshes.mesh_number() == 1 and new.label() == "wall" and np.array_equal(new.transform_matrix(), matrix)
    moved = np.abs(new.vertex_matrix()[:count] - positions).max(axis=1) > 0
    assert 0.05 < moved.mean() < 1
    quality = new.vertex_scalar_array()
    assert (quality[:count][~moved] == 0).all() and quality.max() > 0.05
    assert np.array_equal(new.vertex_color_matrix()[:count], colors)
    assert np.array_equal(new.vertex_custom_scalar_attribute_array("age")[:count], np.arange(count))
    assert new.texture_number() == 1 and new.has_wedge_tex_coord()
    if subdivide:
        assert new.vertex_number() > 2 * count
        assert new.wedge_tex_coord_matrix().min() >= 0 and new.wedge_tex_coord_matrix().max() <= 1
    else:
        assert np.array_equal(new.face_matrix(), faces) and np.array_equal(new.wedge_tex_coord_matrix(), corners)
        assert np.array_equal(new.face_scalar_array(), np.arange(len(faces)))
        assert new.selected_face_number() == 1
    assert [s.get("name") for s in saved_history(meshes)] == ["PAGaS Depth Refinement"]
    if not subdivide:  # and once more, on what it made
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST, output="displace")
        assert len(saved_history(meshes)) == 2


@pytest.mark.parametrize("output", ["mesh", "tsdf"])
def test_same_as_refine_mesh(made, output):
    """The step is refine_mesh, in the layer's frame."""
    import pagas_cl
    from pagas_cl.filters.parameters import request

    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(*made.initial_mesh(3.0)), "wall")
    config = request({"settings": FAST, "voxel": "2"}, "test").config
    photos = [v.image for v in made.views]
    expected = pagas_cl.refine_mesh(meshes.current_mesh(), made.cameras[:3], photos, config=config, output=output)
    meshes.apply_pagas_depth_refinement(made.views, settings=FAST, voxel=2.0, output=output)
    assert np.array_equal(meshes.current_mesh().vertex_matrix(), expected.vertex_matrix())
    assert np.array_equal(meshes.current_mesh().face_matrix(), expected.face_matrix())


@pytest.mark.parametrize("arguments, sentence", [
    ({"preset": "best"}, "unknown preset"), ({"output": "both"}, "expected 'mesh', 'tsdf' or 'displace'"),
    ({"radius": "1"}, "radius is '1', expected a number"), ({"voxel": -1}, "fusion.voxel is -1"),
    ({"context_views": 1.5}, "whole number"), ({"settings": "a.b=1"}, "unknown setting"),
    ({"preset": 3}, "expected text"),
    ({"triangles": 3}, "triangles is 3, expected"), ({"triangles": 100, "output": "tsdf"}, "for output='mesh'"),
    ({"subdivide": 0.1}, "at least 0.25"), ({"subdivide": float("nan")}, "expected a number"),
])
def test_wrong_arguments_are_refused_before_anything_happens(made, arguments, sentence):
    meshes = layer(made)
    with pytest.raises(InputError, match=sentence):
        meshes.apply_pagas_depth_refinement(made.views, **arguments)
    assert meshes.mesh_number() == 1 and saved_history(meshes) == []


def test_a_face_that_names_a_vertex_twice_is_refused_before_the_work(made):
    vertices, faces = made.initial_mesh(3.0)
    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(vertices, np.vstack([faces, [[0, 0, 1]]])), "wall")
    with pytest.raises(InputError, match=f"1 of the {len(faces) + 1} faces of 'wall' name one vertex twice, .* apply "
                                         "meshing_remove_null_faces first"):
        meshes.apply_pagas_depth_refinement(made.views, settings=FAST)
    assert meshes.mesh_number() == 1 and saved_history(meshes) == []


def test_a_new_layer_has_as_many_triangles_as_requested(made):
    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(*made.initial_mesh(3.0)), "wall")
    meshes.apply_pagas_depth_refinement(made.views, settings=FAST, triangles=600)
    assert abs(meshes.current_mesh().face_number() - 600) <= 12
    assert {p.get("name"): p.get("value") for p in saved_history(meshes)[0]}["triangles"] == "600"


def test_numbers_of_numpy_are_numbers(made):
    for value, written in ((np.int64(300), "300"), (np.float64(0.5), "0.5"), (np.float32(0.5), "0.5")):
        given = {parameter.python: None for parameter in PARAMETERS}
        given["triangles" if isinstance(value, np.integer) else "radius"] = value
        assert list(to_values(given).values()) == [written]


def test_a_set_without_meshes_is_refused(made):
    with pytest.raises(InputError, match="a pymeshlab MeshSet without meshes; load one first"):
        getattr(Meshes(), METHOD)(made.views, progress=False)


def test_a_point_cloud_is_named_where_there_are_other_layers(made):
    vertices, faces = made.initial_mesh(3.0)
    meshes = Meshes()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces), "wall")
    meshes.add_mesh(pymeshlab.Mesh(vertices), "sparse")
    with pytest.raises(InputError, match=f"the current layer 'sparse' has {len(vertices)} vertices and no faces: make "
                                         "another layer the current one"):
        meshes.apply_pagas_depth_refinement(made.views)


def test_scene_may_come_in_any_form(made, tmp_path):
    from support.synthetic.scene import write_scene

    from pagas_cl.scene.view import Scene

    write_scene(made, tmp_path / "SCENE")
    pairs = (made.cameras[:3], [v.image for v in made.views])
    for scene in (tmp_path / "SCENE", str(tmp_path / "SCENE"), Scene(made.views), made.views, pairs):
        assert len(scene_views(scene)) == 3
    for scene in (None, 3, [], [1]):
        with pytest.raises(InputError):
            scene_views(scene)


def test_a_failure_leaves_the_history(made):
    meshes = layer(made)
    meshes.apply_filter("compute_normal_per_face")
    with pytest.raises(InputError, match="cameras see the mesh"):
        meshes.set_matrix(transformmatrix=np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3) * 1e6, freeze=False)
        meshes.apply_pagas_depth_refinement(made.views)
    names = [s.get("name") for s in saved_history(meshes)]
    assert names == ["Re-Compute Face Normals", "Matrix: Set/Copy Transformation"]
