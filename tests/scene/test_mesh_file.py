"""Mesh files: what is written is read back, by Open3D, MeshLab and trimesh too, with all digits or not at all."""

import os
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pagas_cl.errors import InputError
from pagas_cl.scene.mesh import Material, Surface, Texture
from pagas_cl.scene.meshes.files import (
    FORMATS,
    SUFFIXES,
    check_digits,
    losses,
    read_content,
    read_mesh,
    write_mesh,
)
from pagas_cl.scene.own_files import is_own_mesh
from pagas_cl.scene.readers.meshlab import MeshLayer, write_project


@pytest.fixture
def surface():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + (450123.4567, 0, -4649876.5432)
    normals = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])
    colors = np.array([[0, 0, 0], [1, 1, 1], [0.2, 0.4, 0.6], [1 / 255, 2 / 255, 3 / 255]])
    return Surface(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2]], normals, colors, np.array([0, 0.25, 0.5, 1]))


def test_ply_keeps_everything(surface, tmp_path):
    large = np.array([2.0**24 + 1, -5, 2**40, 0])      # whole numbers that float32 has no room for
    surface = replace(surface, attributes={"part": np.array([1.0, 2, 3, 4]), "s": np.array([0, 0.25, 0.5, 0.75]),
                                           "id": large})
    path = tmp_path / "new" / "a.ply"
    write_mesh(path, surface)
    read = read_mesh(path)
    assert (read.vertices == surface.vertices).all() and (read.faces == surface.faces).all()
    assert np.abs(read.normals - surface.normals).max() < 1e-6 and np.abs(read.colors - surface.colors).max() < 1e-6
    assert (read.quality == surface.quality).all() and list(read.attributes) == ["part", "s", "id"]
    assert all((read.attributes[name] == surface.attributes[name]).all() for name in read.attributes)
    assert [p.name for p in path.parent.iterdir()] == ["a.ply"]


def test_lines_end_alike_on_every_system(surface, tmp_path, monkeypatch):
    """pymeshlab misreads the matrices of a project whose lines end as Windows ends them."""
    whole = open

    def as_windows(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, *more):
        return whole(file, mode, buffering, encoding, errors, newline or (None if "b" in mode else "\r\n"), *more)

    for module in ("builtins", "io"):
        monkeypatch.setattr(f"{module}.open", as_windows)
    texture = Texture(np.zeros((3, 3, 2)), np.zeros(3, np.int32), (Material("a", (("Kd 1 1 1", None),)),))
    for kind in (".obj", ".off"):
        write_mesh(tmp_path / f"a{kind}", replace(surface, quality=None, texture=texture if kind == ".obj" else None))
    write_project(tmp_path / "a.mlp", [], [MeshLayer("a", tmp_path / "a.obj", np.eye(4))])
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".mlp", ".mtl", ".obj", ".off"]
    assert not [path for path in tmp_path.iterdir() if b"\r" in path.read_bytes()]


@pytest.mark.parametrize("name", ["two message", "", "ümlaut", "x", "a\nb"])
def test_a_name_that_a_ply_file_cannot_have(surface, tmp_path, name):
    with pytest.raises(InputError, match="attribute"):
        write_mesh(tmp_path / "a.ply", replace(surface, attributes={name: np.zeros(4)}))
    assert not list(tmp_path.iterdir())


def test_ply_is_what_open3d_reads(surface, tmp_path):
    o3d = pytest.importorskip("open3d")
    write_mesh(tmp_path / "a.ply", surface)
    read, other = read_mesh(tmp_path / "a.ply"), o3d.io.read_triangle_mesh(str(tmp_path / "a.ply"))
    for own, theirs in ((read.vertices, other.vertices), (read.faces, other.triangles),
                         (read.normals, other.vertex_normals), (read.colors, other.vertex_colors)):
        assert (own == np.asarray(theirs)).all()


@pytest.mark.parametrize("change, message", [
    (("little_endian", "big_endian"), ""), (("end_header\n", "end_header\r\n"), None),
    (("vertex_indices", "vertex_index"), None), (("vertex_indices", "corners"), "0 faces"),
    (("uchar int vertex", "uchar float vertex"), ""), (("float quality", "float red"), "twice"),
    (("float quality", "unknown quality"), "expected a format before it, a type"),
    (("property double z\n", ""), "no x, y"), (("element face", "element edge"), "0 faces"),
    (("float quality", "list uchar int quality"), ""),
    (("\x03", "\x04"), ""), (("\x03", "\xff"), ""), (("end_header", "end"), "no end"), (("\n", "\r\n"), None),
    (("format binary_little_endian", "format ascii"), "")])
def test_a_damaged_ply_is_an_error_or_the_same_mesh(surface, tmp_path, change, message):
    write_mesh(tmp_path / "a.ply", surface)
    old, new = (text.encode("latin-1") for text in change)
    header, end, data = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    parts = (header, end, data.replace(old, new)) if old == b"\x03" else ((header + end).replace(old, new), data)
    (tmp_path / "a.ply").write_bytes(b"".join(parts))
    if message is None:
        assert (read_mesh(tmp_path / "a.ply").vertices == surface.vertices).all()
        return
    with pytest.raises(InputError, match=f"a.ply.*{message}"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_polygons_of_a_ply_keep_what_vertices_have(tmp_path, form):
    """Triangles, quads and a polygon that is not convex, in any order, with columns before and after the corners."""
    order = {"binary_big_endian": ">"}.get(form, "<")
    corners = [[0, 1, 2, 3], [0, 1, 2], [4, 5, 6, 7]]
    places = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 0], [9, 5, 0], [6, 6, 0], [5, 9, 0]], float)
    heat = np.arange(8) / 3
    header = [f"ply\nformat {form} 1.0\nelement camera 1\nproperty float f\nelement vertex 8"]
    header += [f"property double {axis}" for axis in "xyz"] + ["property double heat", "element face 3",
               "property uchar part", "property list uchar int vertex_indices", "property float area", "end_header\n"]
    if form == "ascii":
        body = "1.5\n" + "".join(f"{x!r} {y!r} {z!r} {h!r}\n" for (x, y, z), h in zip(places.tolist(), heat.tolist(),
                                                                                     strict=True))
        body += "".join(f"7 {len(face)} {' '.join(map(str, face))} 0.5\n" for face in corners)
        body = body.encode()
    else:
        body = np.array(1.5, f"{order}f4").tobytes() + np.column_stack([places, heat]).astype(f"{order}f8").tobytes()
        for face in corners:
            body += bytes([7, len(face)]) + np.array(face, f"{order}i4").tobytes()
            body += np.array(.5, f"{order}f4").tobytes()
    (tmp_path / "p.ply").write_bytes("\n".join(header).encode() + body)
    read = read_mesh(tmp_path / "p.ply")
    assert (read.vertices == places).all() and (read.attributes["heat"] == heat).all()
    assert read.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [4, 5, 6], [4, 6, 7]]
    assert losses(read_content(tmp_path / "p.ply"), "out.ply") == ["elements 'camera'", "face property 'part'",
                                                                  "face property 'area'"]


def test_a_polygon_that_is_not_convex_is_not_folded(tmp_path):
    (tmp_path / "a.off").write_text("OFF\n4 1 0\n6 6 0\n5 9 0\n5 5 0\n9 5 0\n4 0 1 2 3\n")      # convex
    (tmp_path / "b.off").write_text("OFF\n4 1 0\n5 9 0\n5 5 0\n9 5 0\n5.5 5.5 0\n4 0 1 2 3\n")  # an arrow's head
    for name, shared in (("a", 0), ("b", 1)):
        read = read_mesh(tmp_path / f"{name}.off")
        assert (read.faces[:, 0] == shared).all()
        first, second = np.cross(*(read.vertices[read.faces[:, k]] - read.vertices[read.faces[:, 0]] for k in (1, 2)))
        assert first @ second > 0


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("offset, scale", [((500000.123456, 5400000.654321, 33.3), 1), ((0, 0, 0), 1e-6),
                                           ((1e-7, -1e-7, 0), 1e-8), ((0, 0, 0), 1e6), ((3, 4, 5), 1)])
def test_coordinates_keep_their_digits_or_are_not_written(tmp_path, suffix, offset, scale):
    vertices = np.random.default_rng(1).random((40, 3)) * scale + offset
    surface = Surface(vertices, np.arange(39).reshape(-1, 3))
    path = tmp_path / f"a{suffix}"
    if suffix in (".stl", ".glb") and np.abs(offset).max() > 1e5:
        for ahead in (True, False):
            with pytest.raises(InputError, match="keep 7 digits of a coordinate.* write .ply, .obj or .off"):
                check_digits(path, surface, ahead)
        with pytest.raises(InputError, match="keep 7 digits"):
            write_mesh(path, surface)
        assert not list(tmp_path.iterdir())
        return
    write_mesh(path, surface)
    read = read_mesh(path)
    error = np.abs(read.vertices[read.faces] - vertices[surface.faces]).max()
    assert error == 0 if suffix not in (".stl", ".glb") else error < 1e-3 * scale
    assert is_own_mesh(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_other_programs_read_the_same_triangles(surface, tmp_path, suffix):
    o3d, pymeshlab = pytest.importorskip("open3d"), pytest.importorskip("pymeshlab")
    small = Surface(surface.vertices - surface.vertices[0], surface.faces, surface.normals, surface.colors)
    path = tmp_path / f"a{suffix}"
    write_mesh(path, small)
    layer, other, third = pymeshlab.MeshSet(), o3d.io.read_triangle_mesh(str(path)), trimesh.load_mesh(str(path),
                                                                                                      process=False)
    layer.load_new_mesh(str(path))
    mesh = layer.current_mesh()
    found = read_mesh(path)
    for vertices, faces in ((found.vertices, found.faces), (np.asarray(other.vertices), np.asarray(other.triangles)),
                            (mesh.transformed_vertex_matrix(), mesh.face_matrix()), (third.vertices, third.faces)):
        assert corners(vertices[faces]) == corners(small.vertices[small.faces])
    if suffix != ".stl":
        assert sorted(np.rint(mesh.vertex_color_matrix()[:, :3] * 255).tolist()) == sorted(
            np.rint(small.colors * 255).tolist())
        assert np.asarray(other.vertex_colors).sum() == pytest.approx(small.colors.sum(), abs=0.02)
        assert found.colors == pytest.approx(small.colors, abs=1e-6)
        assert found.normals == pytest.approx(small.normals, abs=1e-6)


def test_assimp_ends_reading_an_off_file(surface, tmp_path):
    """It never ended where a comment stood before the numbers: Open3D's tensor reader, which is tried in a process that
    can be stopped."""
    pytest.importorskip("open3d")
    write_mesh(tmp_path / "a.off", replace(surface, vertices=surface.vertices - surface.vertices[0]))
    code = f"import open3d; print(len(open3d.t.io.read_triangle_mesh({str(tmp_path / 'a.off')!r}).triangle.indices))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.split()[-1:] == [str(len(surface.faces))], done.stderr


def corners(triangles):
    """Of each triangle its corners from the least one on, in their order, all triangles sorted."""
    triangles = np.round(np.asarray(triangles, float), 5).tolist()
    return sorted(min(triangle[turn:] + triangle[:turn] for turn in range(3)) for triangle in triangles)


def test_meshlab_finds_the_quality(surface, tmp_path):
    pymeshlab = pytest.importorskip("pymeshlab")
    write_mesh(tmp_path / "a.ply", surface)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "a.ply"))
    mesh = meshes.current_mesh()
    assert (mesh.vertex_matrix() == surface.vertices).all()
    assert (mesh.vertex_scalar_array() == surface.quality).all()
    assert np.abs(mesh.vertex_color_matrix()[:, :3] - surface.colors).max() < 1e-6


def test_names_that_cannot_be_written(surface, tmp_path):
    with pytest.raises(InputError, match="unknown kind '.xyz', expected one of .ply"):
        write_mesh(tmp_path / "a.xyz", surface)
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_mesh(tmp_path / "b.ply", surface)


def test_files_of_others_have_no_mark(surface, tmp_path):
    small = replace(surface, vertices=surface.vertices - surface.vertices[0])
    for suffix in SUFFIXES:
        path = tmp_path / f"b{suffix}"
        trimesh.Trimesh(small.vertices, small.faces).export(path)
        assert not is_own_mesh(path)
        write_mesh(path, small)
        assert is_own_mesh(path)
        path.write_bytes(path.read_bytes().replace(b"pagas", b"other"))
        assert not is_own_mesh(path)
    for name, text in (("s.obj", "# Sculpted by Ann over a mesh written by pagas_cl"),
                       ("s.off", "OFF\n# was written by pagas_cl"),
                       ("s.ply", "ply\nformat ascii 1.0\ncomment cleaned, which was written by pagas_cl")):
        (tmp_path / name).write_text(f"{text}\n")
        assert not is_own_mesh(tmp_path / name)     # words about a mesh are no mark of it
    (tmp_path / "e.ply").write_bytes(b"")
    for name in ("e.ply", "none.ply", "", "a.mlp"):
        assert not is_own_mesh(tmp_path / name)


@pytest.mark.parametrize("kind, message", [("pipe", "is a named pipe"), ("device", "is a device"),
                                         ("socket", "is a socket"), ("folder", "is a folder"),
                                         ("none", "does not exist"), ("long", "cannot be read: File name too long")])
def test_what_is_no_file_is_called_what_it_is(tmp_path, kind, message):
    path = tmp_path / ("n" * 300 if kind == "long" else "a.ply")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(os.path.relpath(path))
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(InputError, match=message):
        read_mesh(path)


@pytest.mark.parametrize("value, message", [("1e38", "vertex 1 has a coordinate of 1e\\+38"),
                                          ("nan", "vertex 1 is not finite"),
                                          ("0", "none of the mesh's 1 triangles has an area")])
@pytest.mark.parametrize("suffix", [".ply", ".off", ".obj"])
def test_the_right_cause_of_a_useless_vertex(tmp_path, value, message, suffix):
    ply = ("ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
           "element face 1\nproperty list uchar int vertex_indices\nend_header\n")
    rows = f"0 0 0\n{value} 0 0\n0 1 0\n3 0 1 2\n"
    text = {".ply": ply + rows, ".off": "OFF 3 1 0\n" + rows,
            ".obj": f"v 0 0 0\nv {value} 0 0\nv 0 1 0\nf 1 2 3\n"}[suffix]
    (tmp_path / f"a{suffix}").write_text(text)
    with pytest.raises(InputError, match=f"a{suffix}.*{message}"):
        read_mesh(tmp_path / f"a{suffix}")


OBJ = """mtllib x.mtl \\
 y.mtl
v 500000.1234567 5400000.456789 0
v -1 0 0
v 0 1 0
v 0 1 2.5
vn 0 0 1
vn 0 0.5 0
vt 0 0
vt 1 0
vt 0.125 1
{}
usemtl b
f 1/1/1 2/2/1 3/3/1
usemtl a
f -1/2/2 -4/1/1 \\
 3/3/1 2/2/1
"""


def test_an_obj_file_keeps_seams_whole_and_digits(tmp_path):
    """Where a vertex has two texture coordinates it is one vertex still."""
    (tmp_path / "a.obj").write_text(OBJ.format(""))
    (tmp_path / "x.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd -s 1 1 1 my wood.png\n")
    (tmp_path / "y.mtl").write_text("newmtl b\nKd 0 1 0\n")
    (tmp_path / "my wood.png").write_bytes(b"wood")
    read = read_mesh(tmp_path / "a.obj")
    assert read.vertices[0].tolist() == [500000.1234567, 5400000.456789, 0] and len(read.vertices) == 4
    assert read.faces.tolist() == [[0, 1, 2], [3, 0, 2], [3, 2, 1]]
    assert read.texture.materials.tolist() == [0, 1, 1] and [m.name for m in read.texture.library] == ["b", "a"]
    assert read.texture.coordinates[1].tolist() == [[1, 0], [0, 0], [0.125, 1]]
    assert read.normals[0].tolist() == [0, 0, 1] and read.normals[3].tolist() == [0, 1, 0]
    (tmp_path / "new").mkdir()
    write_mesh(tmp_path / "new" / "c.obj", read)
    again = read_mesh(tmp_path / "new" / "c.obj")
    assert (again.vertices == read.vertices).all() and (again.faces == read.faces).all()
    assert (again.texture.coordinates == read.texture.coordinates).all()
    assert (again.texture.materials == read.texture.materials).all()
    assert (tmp_path / "new" / "c.mtl").read_text().splitlines()[1:] == [
        "newmtl b", "Kd 0 1 0", "newmtl a", "Kd 1 0 0", "map_Kd -s 1 1 1 c_0.png"]
    assert (tmp_path / "new" / "c_0.png").read_bytes() == b"wood"


@pytest.mark.parametrize("faces", ["f 1 2 3 999999999", "f 1 2 0", "f -9 1 2", "f 1//9 2//1 3//1", "f 1/9 2/1 3/1",
                                   "f 1 2 x", "f 1/2/3/4 2 3", "f / 1 2", "f 1.5 2 3", "f 1 2 99999999999999999999"])
def test_every_index_of_an_obj_file_is_checked(tmp_path, faces):
    (tmp_path / "a.obj").write_text(OBJ.format(faces))
    with pytest.raises(InputError, match="a.obj"):
        read_mesh(tmp_path / "a.obj")


def test_each_kind_has_a_reader_of_what_is_written():
    assert {*SUFFIXES} < {*FORMATS}


@pytest.mark.parametrize("second, lost", [("255", ("texture coordinates",)),
                                          ("128", ("texture coordinates", "the opacity of vertices"))])
def test_opacity_that_differs_is_lost_of_an_off_file(tmp_path, second, lost):
    (tmp_path / "a.off").write_text("STCOFF\n3 1 0\n0 0 0 9 9 9 255 0 0\n1 0 0 9 9 9 255 1 0\n"
                                    f"0 1 0 9 9 9 {second} 0 1\n3 0 1 2\n")
    assert read_content(tmp_path / "a.off").lost == lost
