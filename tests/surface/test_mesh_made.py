"""A mesh from photos to file: as many triangles as requested, colours of the photos, files that other programs open,
and a sentence where it is coarser than wanted."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.scenes import relief_scene

import pagas_cl
from pagas_cl.errors import DeviceMemoryError, InputError
from pagas_cl.method.surface.keep_mesh import kept_mesh
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.surface.on_vertices import vertex_colors
from pagas_cl.refine import refine_scene, refine_views
from pagas_cl.scene.inputs import as_views
from pagas_cl.scene.mesh import Material, Surface, Texture
from pagas_cl.scene.meshes.files import write_mesh

pytestmark = pytest.mark.slow
CONFIG = pagas_cl.preset("fast").with_settings(pyramid__steps=(10,), effects__cameras="off")


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, contexts=3, held_out=0)


def refined(made, mesh, device, **options):
    """The mesh, and its limit."""
    views = as_views(made.cameras, [view.load_image() for view in made.views], None)
    done = refine_scene(views, mesh, None, CONFIG, making=MeshOptions("mesh", **options))
    return done.mesh, done.mesh_limit


def test_so_many_triangles_more_or_fewer(made, device, caplog):
    given = Surface(*made.initial_mesh(8.0))
    for number in (len(given.faces) // 3, 3 * len(given.faces), 40 * len(given.faces)):
        mesh, limit = refined(made, given, device, triangles=number)
        assert abs(len(mesh.faces) - number) <= 0.02 * number and not limit and not caplog.text
    again, _ = refined(made, given, device, triangles=number)
    assert again.vertices.tobytes() == mesh.vertices.tobytes() and again.faces.tobytes() == mesh.faces.tobytes()


@pytest.mark.parametrize("limits, reason", [
    (dict(memory_mb=0.5), "the memory planned for it holds 1111 triangles"),
    (dict(memory_mb=0.05), "triangles, and there is room for 111 (--memory"),
    (dict(memory_mb=0.5, triangles=5000), "not 5000 as requested: the memory planned"),
    (dict(triangles=100), "not 100 as requested: given triangles stay"),
])
def test_what_ends_the_splitting_is_said(made, device, caplog, limits, reason):
    vertices, faces = made.initial_mesh(8.0)
    texture = Texture(np.random.default_rng(0).uniform(size=(len(faces), 3, 2)), np.zeros(len(faces), np.int32),
                      (Material("a"),))
    _, limit = refined(made, Surface(vertices, faces, texture=texture), device, **limits)
    assert reason in limit and limit in caplog.text


@pytest.mark.filterwarnings("ignore::pagas_cl.errors.NothingRefinedWarning")
def test_of_an_unchanged_mesh_it_is_not_said_that_it_could_be_finer(made, caplog):
    views = as_views(made.cameras, [np.zeros_like(view.load_image()) for view in made.views], None)
    given, making = Surface(*made.initial_mesh(8.0)), MeshOptions("mesh", memory_mb=0.05)
    done = refine_scene(views, given, None, CONFIG, making=making)
    assert done.mesh_limit == "unchanged: nowhere do two refined views agree on where it should be"
    assert "the mesh is unchanged" in caplog.text and "coarser" not in caplog.text
    assert np.array_equal(done.mesh.vertices, given.vertices)
    assert not np.shares_memory(done.mesh.vertices, given.vertices), "whoever changes one array changed the other"


def test_what_sits_on_vertices_stays_unless_there_are_to_be_fewer(made, device):
    vertices, faces = made.initial_mesh(3.0)
    given = Surface(vertices, faces, colors=np.random.default_rng(1).uniform(size=vertices.shape))
    mesh, _ = refined(made, given, device)
    assert np.array_equal(mesh.colors[:len(vertices)], given.colors)
    mesh, _ = refined(made, given, device, tolerance=0.3)
    known = {color.tobytes() for color in given.colors}
    assert len(mesh.vertices) < len(vertices) and sum(color.tobytes() in known for color in mesh.colors) > 100


@dataclass
class Depth:
    """What colours take of a result."""

    camera: object
    depth: np.ndarray


def test_colours_are_those_of_the_photos(made):
    """One photo: the very pixel; masked out: not at all; behind the surface or out of the picture: what was given."""
    view = as_views(made.cameras[:1], [made.views[0].load_image()], None)[0]
    depth = made.true_depth(view.camera).astype(np.float32)
    rays = view.camera.rays() * depth[..., None]
    places = (rays[10:60:7, 10:80:7] @ view.camera.world_to_camera[:3, :3] + view.camera.center).reshape(-1, 3)
    photo = view.load_image()[10:60:7, 10:80:7].reshape(-1, 3) / 255
    far = view.camera.center + 1.5 * (places - view.camera.center)
    both, given = np.concatenate([places, far]), np.full((2 * len(places), 3), 0.25)
    colors = vertex_colors(both, [view], [Depth(view.camera, depth)], given)
    assert np.allclose(colors[:len(places)], photo) and (colors[len(places):] == 0.25).all()
    masked = replace(view, mask=np.zeros(depth.shape, bool))
    assert (vertex_colors(places, [masked], [Depth(view.camera, depth)]) == 0.5).all()
    assert np.allclose(vertex_colors(places, [view, masked], 2 * [Depth(view.camera, depth)]), photo)


def test_files_open_in_other_programs(made, device, tmp_path):
    o3d, pymeshlab, trimesh = map(pytest.importorskip, ("open3d", "pymeshlab", "trimesh"))
    mesh, _ = refined(made, Surface(*made.initial_mesh(4.0)), device, triangles=1500, color=True)
    photo = made.views[0].load_image().reshape(-1, 3) / 255
    middle = np.abs(mesh.vertices[:, :2]).max(axis=1) < 0.4 * np.abs(mesh.vertices[:, :2]).max()
    assert np.abs(mesh.colors[middle].mean(axis=0) - photo.mean(axis=0)).max() < 0.1
    assert mesh.colors[middle].std() > 0.5 * photo.std()
    for kind in ("ply", "obj", "glb", "stl"):
        path = tmp_path / f"m.{kind}"
        write_mesh(path, mesh)
        read = trimesh.load(path, force="mesh")
        assert len(read.faces) == len(mesh.faces)
        legacy = o3d.io.read_triangle_mesh(str(path))
        assert len(legacy.triangles) == len(mesh.faces)
        meshes = pymeshlab.MeshSet()
        meshes.load_new_mesh(str(path))
        assert meshes.current_mesh().face_number() == len(mesh.faces)
        if kind != "stl":
            assert legacy.has_vertex_colors() and legacy.has_vertex_normals()
            assert np.allclose(np.asarray(legacy.vertex_colors).mean(axis=0), mesh.colors.mean(axis=0), atol=0.01)


@pytest.mark.parametrize("making, advice", [
    (MeshOptions("displace", subdivide=0.5), "--subdivide"), (MeshOptions("displace"), "simplify it first"),
    (MeshOptions("mesh"), "--memory")])
def test_a_mesh_too_large_for_the_device_is_refused_with_what_to_do(made, device, monkeypatch, making, advice):
    results = refine_views(made.views, [made.initial_depth(view.camera) for view in made.views], config=CONFIG,
                           device=device)
    device.memory.clear()
    monkeypatch.setattr(device.memory, "limit", device.memory.held + 500_000)
    with pytest.raises(DeviceMemoryError, match=f"^the mesh is too large for the device: .* MB .*; .*{advice}"):
        kept_mesh(Surface(*made.initial_mesh(1.0)), made.views, results, CONFIG, making, device)


def test_colour_is_a_yes_or_no():
    with pytest.raises(InputError, match="color is"):
        pagas_cl.refine_mesh((np.eye(3), np.array([[0, 1, 2]])), [], [], color="red")
