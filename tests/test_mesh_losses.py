"""--keep-mesh: what cannot be kept is told before the work; materials and textures of others are never replaced."""

import numpy as np
import pytest
from PIL import Image
from support.job_scenes import write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import OutputError
from pagas_cl.scene.files import replaced_with_others
from pagas_cl.scene.mesh_file import write_mesh
from pagas_cl.scene.mesh_losses import losses

pytestmark = pytest.mark.slow

o3d = pytest.importorskip("open3d")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("losses") / "scene", 4)


PLY = """ply
format ascii 1.0
comment made by hand
element vertex 3
property float x
property float y
property float z
{vertex}element face 1
property list uchar int vertex_indices
{face}end_header
0 0 0{v}
1 0 0{v}
0 1 0{v}
3 0 1 2{f}
"""
LOST = {"alpha": ("property uchar alpha\n", "", "vertex property 'alpha'"),
        "quality": ("property float quality\n", "", "vertex property 'quality'"),
        "place": ("property float s\nproperty float t\n", "", "vertex property 's', vertex property 't'"),
        "custom": ("property int part\n", "", "vertex property 'part'"),
        "face": ("", "property uchar red\n", "face property 'red'"),
        "corners": ("", "property list uchar float texcoord\n", "face property 'texcoord'")}


@pytest.mark.parametrize("name", LOST)
def test_what_a_ply_file_would_lose(tmp_path, name):
    vertex, face, words = LOST[name]
    (tmp_path / "m.ply").write_text(PLY.format(vertex=vertex, face=face, v=" 1" * vertex.count("property"),
                                               f=" 6 0 0 0 0 0 0" if "list" in face else " 1" * bool(face)))
    assert ", ".join(losses(tmp_path / "m.ply", "out.ply")) == words


def test_what_is_kept_is_not_told(scene, tmp_path):
    mesh = o3d.io.read_triangle_mesh(str(scene / "mesh_coarse.ply"))
    mesh.paint_uniform_color([1, 0, 0])
    mesh.compute_vertex_normals()
    o3d.io.write_triangle_mesh(str(tmp_path / "m.ply"), mesh)
    assert losses(tmp_path / "m.ply", "out.ply") == losses(tmp_path / "m.ply", "out.obj") == []
    assert losses(tmp_path / "m.ply", "out.stl") == ["vertex colours"]


def textured(scene, path, parts=1):
    """The scene's mesh as an OBJ file with a texture, in so many groups and materials."""
    mesh = o3d.io.read_triangle_mesh(str(scene / "mesh_coarse.ply"))
    corners, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles) + 1
    lines = ["mtllib m.mtl", *(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", "vt 1 0", "vt 0 1"]
    for part in range(parts):
        lines += [f"g part{part}", f"usemtl paint{part}",
                  *(f"f {a}/1 {b}/2 {c}/3" for a, b, c in np.array_split(faces, parts)[part])]
    path.write_text("\n".join(lines) + "\n")
    path.with_name("m.mtl").write_text("".join(f"newmtl paint{part}\nmap_Kd wood.png\n" for part in range(parts)))
    Image.new("RGB", (4, 4), (90, 60, 30)).save(path.with_name("wood.png"))
    return path


def refine(scene, mesh, output, *more):
    return command_line.run(["refine", str(scene), "--mesh", str(mesh), "--output", str(output), "--keep-mesh",
                             "--quiet", "--set", "pyramid.steps=3", "--views", "target", "context_00", *more])


def test_it_is_told_before_the_work(scene, tmp_path, capsys, monkeypatch):
    mesh = textured(scene, tmp_path / "m.obj", 2)
    assert losses(mesh, "out.obj") == ["2 materials", "2 groups"]
    with monkeypatch.context() as patch:
        patch.setattr("pagas_cl.commands.refine.refine_views", lambda *_, **__: pytest.fail("refined"))
        assert refine(scene, mesh, tmp_path / "out.ply") == 2
    told = capsys.readouterr().err
    assert "would lose of mesh" in told and "2 materials, 2 groups, texture coordinates; pass --allow-loss" in told
    assert refine(scene, mesh, tmp_path / "out.ply", "--allow-loss") == 0 and (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("name", ["out.mtl", "out_0.png"])
def test_materials_and_textures_of_others_stay(scene, tmp_path, capsys, name):
    mesh, out = textured(scene, tmp_path / "m.obj"), tmp_path / "out"
    out.mkdir()
    (out / name).write_text("precious")
    assert refine(scene, mesh, out / "out.obj") == 2
    assert f"{name}, which is written by another program" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == [name] and (out / name).read_text() == "precious"
    (out / name).unlink()
    assert refine(scene, mesh, out / "out.obj") == 0 and (out / name).exists()
    before = (out / "out.obj").read_bytes()
    assert refine(scene, mesh, out / "out.obj") == 0 and (out / "out.obj").read_bytes() == before


def test_what_comes_between_is_not_replaced_and_nothing_is_lost(tmp_path):
    (tmp_path / "a.mtl").write_text("precious")
    with pytest.raises(OutputError, match="a.mtl is there and was not written by pagas_cl") as told:
        with replaced_with_others(tmp_path / "a.obj") as new:
            new.write_text("mesh")
            new.with_suffix(".mtl").write_text("material")
    aside = next(tmp_path.glob("a~*"))
    assert str(aside) in str(told.value) and (aside / "a.obj").read_text() == "mesh"
    assert (tmp_path / "a.mtl").read_text() == "precious" and not (tmp_path / "a.obj").exists()


def test_an_obj_file_is_the_same_twice(tmp_path):
    from pagas_cl.scene.mesh import Surface

    surface = Surface(np.eye(3), [[0, 1, 2]])
    write_mesh(tmp_path / "a.obj", surface)
    before = (tmp_path / "a.obj").read_bytes()
    write_mesh(tmp_path / "a.obj", surface)
    assert (tmp_path / "a.obj").read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.obj"]


def test_layers_of_others_stay(scene, tmp_path, capsys):
    """A project's layers are files beside it; those of another project, or of nobody, are not replaced."""
    pytest.importorskip("pymeshlab")
    (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript><FilterScript><filter name="Invert Faces Orientation">'
                                    '</filter></FilterScript>')
    command = ["script", str(tmp_path / "s.mlx"), "--mesh", str(scene / "mesh_coarse.ply"), "--output",
               str(tmp_path / "out.mlp"), "--quiet"]
    (tmp_path / "out_0.ply").write_text("precious")
    assert command_line.run(command) == 2 and "may replace" in capsys.readouterr().err
    assert (tmp_path / "out_0.ply").read_text() == "precious"
    (tmp_path / "out_0.ply").unlink()
    assert command_line.run(command) == 0 == command_line.run(command)
