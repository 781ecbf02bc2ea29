"""Surface, and its ways to and from the real Open3D and pymeshlab."""

import numpy as np
import pytest

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.kinds import from_surface, to_surface

UTM = np.array([450123.4567, 4649876.5432, 123.4])


@pytest.fixture
def surface():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(20, 3)) + UTM
    faces = np.array([(i, i + 1, i + 2) for i in range(18)])
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(vertices, faces, normals, rng.integers(0, 256, (20, 3)) / 255, rng.random(20))


def legacy(surface):
    o3d = pytest.importorskip("open3d")
    return from_surface(surface, o3d.geometry.TriangleMesh())


def test_open3d_legacy_is_exact(surface):
    back = to_surface(legacy(surface))
    for name in ("vertices", "faces", "normals", "colors"):
        assert np.array_equal(getattr(back, name), getattr(surface, name)), name


def test_open3d_tensor_keeps_utm_coordinates(surface):
    o3d = pytest.importorskip("open3d")
    for dtype in (o3d.core.float32, o3d.core.float64):
        like = o3d.t.geometry.TriangleMesh()
        like.vertex["positions"] = o3d.core.Tensor(np.zeros((3, 3)), dtype)
        made = from_surface(surface, like)
        assert type(made) is type(like)
        back = to_surface(made)
        assert np.array_equal(back.vertices, surface.vertices) and np.array_equal(back.faces, surface.faces)
        assert np.abs(back.normals - surface.normals).max() < 1e-7
        assert np.abs(back.colors - surface.colors).max() < 1e-7
        assert np.abs(back.quality - surface.quality).max() < 1e-7


def test_open3d_tensor_of_float32_stays_one_where_nothing_is_lost(surface):
    o3d = pytest.importorskip("open3d")
    like = o3d.t.geometry.TriangleMesh()
    like.vertex["positions"] = o3d.core.Tensor(np.zeros((3, 3), np.float32))
    near = Surface(surface.vertices - UTM, surface.faces)
    assert from_surface(near, like).vertex["positions"].dtype == o3d.core.float32


def test_open3d_tensor_colours_of_8_bit(surface):
    o3d = pytest.importorskip("open3d")
    mesh = from_surface(surface, o3d.t.geometry.TriangleMesh())
    mesh.vertex["colors"] = o3d.core.Tensor(np.rint(surface.colors * 255).astype(np.uint8))
    assert np.array_equal(to_surface(mesh).colors, surface.colors)


def test_pymeshlab_keeps_all_but_its_own_normals(surface):
    pymeshlab = pytest.importorskip("pymeshlab")
    mesh = from_surface(surface, pymeshlab.Mesh(V))
    back = to_surface(mesh)
    assert np.array_equal(back.vertices, surface.vertices) and np.array_equal(back.faces, surface.faces)
    assert np.array_equal(back.colors, surface.colors) and np.array_equal(back.quality, surface.quality)


def test_pymeshlab_layer_matrix_is_applied(surface):
    pymeshlab = pytest.importorskip("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(from_surface(Surface(surface.vertices - UTM, surface.faces), pymeshlab.Mesh(V)))
    meshes.compute_matrix_from_translation(traslmethod="XYZ translation", axisx=5, freeze=False)
    back = to_surface(meshes)
    assert np.abs(back.vertices - (surface.vertices - UTM + (5, 0, 0))).max() < 1e-9
    assert np.array_equal(to_surface(meshes.current_mesh()).vertices, back.vertices)


def test_pair_and_path(surface, tmp_path):
    o3d = pytest.importorskip("open3d")
    vertices, faces = from_surface(to_surface((surface.vertices, surface.faces)), ([], []))
    assert np.array_equal(vertices, surface.vertices) and np.array_equal(faces, surface.faces)
    o3d.io.write_triangle_mesh(str(tmp_path / "a.ply"), legacy(surface))
    assert np.array_equal(to_surface(tmp_path / "a.ply").vertices, surface.vertices)
    assert from_surface(surface, tmp_path / "a.ply") is surface


V, F = np.eye(3), np.array([[0, 1, 2]])


@pytest.mark.parametrize("mesh, message", [
    ((np.zeros((0, 3)), np.zeros((0, 3), int)), "empty: 0 vertices and 0 faces; of a file that it cannot read Open3D"),
    ((V, np.zeros((0, 3), int)), "empty"),
    ((V * np.nan, F), "vertex 0 is not finite"), ((V, F + 1), "names vertex 3, expected 0 to 2"),
    ((V, F - 1), "names vertex -1"), ((V, F * 1.0), "dtype float64"), ((V[:, :2], F), r"shape \(3, 2\)"),
    ((V, np.zeros((1, 4), int)), "triangulate"), ((V, "abc"), "faces"), (([["a"]], F), "numbers"),
    ("nowhere.ply", "does not exist"), (42, "expected an Open3D TriangleMesh"),
])
def test_bad_meshes_are_refused(mesh, message):
    with pytest.raises(InputError, match=message):
        to_surface(mesh)


def test_empty_meshes_of_every_library():
    o3d, pymeshlab = pytest.importorskip("open3d"), pytest.importorskip("pymeshlab")
    for mesh in (o3d.geometry.TriangleMesh(), o3d.t.geometry.TriangleMesh(), pymeshlab.Mesh(V), pymeshlab.MeshSet()):
        with pytest.raises(InputError, match="empty"):
            to_surface(mesh)


def test_of_a_point_cloud_it_is_said_what_to_do():
    o3d = pytest.importorskip("open3d")
    for cloud in (o3d.geometry.PointCloud(), o3d.t.geometry.PointCloud()):
        with pytest.raises(InputError, match="mesh is a PointCloud, expected .*; a point cloud has to be made a mesh"):
            to_surface(cloud)
    with pytest.raises(InputError, match="3 vertices and 0 faces; a point cloud has to be made a mesh"):
        to_surface(pytest.importorskip("pymeshlab").Mesh(V))


def test_file_that_is_no_mesh(tmp_path):
    for name, message in (("a.ply", "no .ply file"), ("a.off", "begins with b'hello'"), ("a.obj", "empty"),
                          ("a.stl", "claims"), ("a.glb", "not valid JSON"), ("a.dae", "unknown kind")):
        (tmp_path / name).write_text("hello")
        with pytest.raises(InputError, match=f"{name}.*{message}"):
            to_surface(tmp_path / name)


def test_attributes_must_fit():
    with pytest.raises(InputError, match=r"colors have shape \(2, 3\), expected \(3, 3\)"):
        Surface(V, F, colors=np.zeros((2, 3)))
