"""--keep-mesh: what cannot be kept is reported before the work; materials and textures of others are never replaced."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.job_scenes import write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError, OutputError
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import check_digits_of_scene, losses, read_content, read_mesh, write_mesh
from pagas_cl.system.files import replaced_with_others

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
LOST = {"alpha": ("property uchar alpha\n", "", "", "vertex property 'alpha'"),      # .ply keeps, other kinds do not
        "quality": ("property float quality\n", "", "", "vertex property 'quality'"),
        "place": ("property float s\nproperty float t\n", "", "", "vertex property 's', vertex property 't'"),
        "custom": ("property int part\n", "", "", "vertex property 'part'"),
        "face": ("", "property uchar red\n", "face property 'red'", "face property 'red'"),
        "corners": ("", "property list uchar float texcoord\n", "face property 'texcoord'", "face property 'texcoord'")}


def lost(mesh, output):
    return losses(read_content(mesh), output)


@pytest.mark.parametrize("name", LOST)
def test_what_a_ply_file_would_lose(tmp_path, name):
    vertex, face, of_ply, of_others = LOST[name]
    (tmp_path / "m.ply").write_text(PLY.format(vertex=vertex, face=face, v=" 1" * vertex.count("property"),
                                               f=" 6 0 0 0 0 0 0" if "list" in face else " 1" * bool(face)))
    assert ", ".join(lost(tmp_path / "m.ply", "out.ply")) == of_ply
    for kind in ("obj", "off", "stl", "glb"):
        assert ", ".join(lost(tmp_path / "m.ply", f"out.{kind}")) == of_others


def test_what_is_kept_is_not_reported(scene, tmp_path):
    mesh = o3d.io.read_triangle_mesh(str(scene / "mesh_coarse.ply"))
    mesh.paint_uniform_color([1, 0, 0])
    mesh.compute_vertex_normals()
    o3d.io.write_triangle_mesh(str(tmp_path / "m.ply"), mesh)
    assert lost(tmp_path / "m.ply", "out.ply") == lost(tmp_path / "m.ply", "out.obj") == []
    for kind in ("off", "glb"):
        assert lost(tmp_path / "m.ply", f"out.{kind}") == []
    assert lost(tmp_path / "m.ply", "out.stl") == ["vertex colours"]


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


def test_it_is_reported_before_the_work(scene, tmp_path, capsys, monkeypatch):
    mesh = textured(scene, tmp_path / "m.obj", 2)
    assert lost(mesh, "out.obj") == ["2 groups"]
    with monkeypatch.context() as patch:
        patch.setattr("pagas_cl.app.commands.refine.refine_scene", lambda *_, **__: pytest.fail("refined"))
        assert refine(scene, mesh, tmp_path / "out.ply") == 2
    shown = capsys.readouterr().err
    assert "would lose of mesh" in shown and "2 groups, 2 materials, texture coordinates; pass --allow-loss" in shown
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
    with pytest.raises(OutputError, match="a.mtl is there and was not written by pagas_cl") as caught:
        with replaced_with_others(tmp_path / "a.obj") as new:
            new.write_text("mesh")
            new.with_suffix(".mtl").write_text("material")
    kept = next(tmp_path.glob("a~*"))
    assert str(kept) in str(caught.value) and (kept / "a.obj").read_text() == "mesh"
    assert (tmp_path / "a.mtl").read_text() == "precious" and not (tmp_path / "a.obj").exists()


def test_an_obj_file_is_the_same_twice(tmp_path):
    surface = Surface(np.eye(3), [[0, 1, 2]])
    write_mesh(tmp_path / "a.obj", surface)
    before = (tmp_path / "a.obj").read_bytes()
    write_mesh(tmp_path / "a.obj", surface)
    assert (tmp_path / "a.obj").read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.obj"]


def test_layers_of_others_stay(scene, tmp_path, capsys):
    """A project's layers are files next to it; those of another project, or of nobody, are not replaced."""
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


@pytest.mark.parametrize("kind", [".off", ".glb", ".stl", ".obj"])
def test_what_other_kinds_of_files_would_lose(tmp_path, kind):
    path = tmp_path / f"m{kind}"
    if kind == ".off":
        path.write_text("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n2 0 1\n")
        expected = ["1 faces of fewer than 3 corners", "face colours"]
    elif kind == ".obj":
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\no a\nf 1 2 3\no b\nf 1 2 3\nl 1 2\ncstype bezier\n")
        expected = ["2 objects", "statements 'cstype'", "statements 'l'"]
    elif kind == ".stl":
        write_mesh(path, Surface(np.eye(3), [[0, 1, 2]]))
        path.write_bytes(path.read_bytes()[:-2] + b"\x01\x80")
        expected = ["face attributes"]
    else:
        picture = Image.new("RGB", (2, 2))
        visual = trimesh.visual.TextureVisuals(uv=np.zeros((3, 2)), image=picture)
        trimesh.Trimesh(np.eye(3), [[0, 1, 2]], visual=visual, process=False).export(path)
        expected = ["1 material", "texture coordinates"]
    assert lost(path, "out.ply") == expected


def test_materials_and_their_colours_come_along(scene, tmp_path):
    """Of each triangle the material of the one that it came from, and all that the library says of it."""
    mesh = textured(scene, tmp_path / "m.obj", 2)
    mesh.write_text("\n".join(line for line in mesh.read_text().splitlines() if not line.startswith("g ")))
    (tmp_path / "m.mtl").write_text("newmtl paint0\nKd 1 0 0\nnewmtl paint1\nKd 0 0.25 0\nd 0.5\nmap_Kd wood.png\n")
    assert lost(mesh, "out.obj") == []
    assert refine(scene, mesh, tmp_path / "out.obj") == 0
    given, made = read_mesh(mesh), read_mesh(tmp_path / "out.obj")
    assert [m.name for m in made.texture.library] == ["paint0", "paint1"]
    assert [m.statements[:2] for m in made.texture.library] == [m.statements[:2] for m in given.texture.library]
    assert (made.texture.materials == given.texture.materials).all()
    assert np.array_equal(made.texture.coordinates, given.texture.coordinates)
    assert (tmp_path / "out_0.png").read_bytes() == (tmp_path / "wood.png").read_bytes()


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_digits_that_would_be_lost_are_reported_before_the_work(scene, tmp_path, capsys, monkeypatch, suffix):
    surface = read_mesh(scene / "mesh_coarse.ply")
    write_mesh(tmp_path / "far.ply", Surface(surface.vertices + [500000, 5400000, 0], surface.faces))
    monkeypatch.setattr("pagas_cl.app.commands.refine.refine_scene", lambda *_, **__: pytest.fail("refined"))
    assert command_line.run(["refine", str(scene), "--mesh", str(tmp_path / "far.ply"), "--output",
                             str(tmp_path / f"out{suffix}"), "--quiet"]) == 2
    assert "keep 7 digits of a coordinate" in capsys.readouterr().err and not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("suffix", [".stl", ".glb", ".ply"])
def test_digits_of_a_fused_mesh_are_judged_by_the_cameras(suffix):
    near = np.random.default_rng(0).normal(size=(9, 3))
    check_digits_of_scene(f"a{suffix}", near)
    check_digits_of_scene(f"a{suffix}", near[:1] + 5e6)
    far = near + [500000, 5400000, 0]
    if suffix == ".ply":
        check_digits_of_scene(f"a{suffix}", far)
    else:
        with pytest.raises(InputError, match="keep 7 digits"):
            check_digits_of_scene(f"a{suffix}", far)
