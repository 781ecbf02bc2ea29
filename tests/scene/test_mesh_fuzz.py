"""Damaged mesh files of every kind: refused in one sentence that names the file, or read with every index in its range;
at once, and in little memory. pymeshlab is only handed what a child process has survived."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import mutations
from support.clouds import load_points
from support.fuzzing import COUNT, bounded

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError
from pagas_cl.method.surface.keep_mesh import check_kept
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import FORMATS, check_mesh_file, read_content, read_mesh, write_mesh

PLY = ("ply\nformat {} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"
       "property list uchar int vertex_indices\nend_header\n")
PLACES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 2, 0], [0, 1, 0]], "f4")
TEXTS = {
    ".ply": PLY.format("ascii") + "0 0 0\n1 0 0\n1 1 0\n.5 2 0\n0 1 0\n5 0 1 2 3 4\n3 0 1 2\n",
    ".off": "COFF\n# c\n4 2 0\n0 0 0 255 0 0 255\n1 0 0 0 0 0 255\n1 1 0 9 9 9 255\n0 1 0 1 2 3 255\n4 0 1 2 3\n"
            "3 0 1 2 255 0 0\n",
    ".obj": "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nusemtl p\n"
            "f 1/1/1 2/2/1 3/3/1\nusemtl q\nf 1 2 3 4\nf -1//1 -2//1 \\\n -3//1\n",
    ".stl": "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
            "endsolid x\n"}


def polygons(form="binary_little_endian", last=4, first=(0, 1, 2, 3)):
    """A binary .ply of a polygon, a pentagon, and a triangle."""
    order = ">" if "big" in form else "<"
    body = PLACES.astype(f"{order}f4").tobytes()
    for face in ([*first, last], [0, 1, 2]):
        body += bytes([len(face)]) + np.array(face, f"{order}i4").tobytes()
    return PLY.format(form).encode() + body


def gltf(change=lambda tree: None):
    """A .gltf with its buffers in it."""
    mesh = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], vertex_colors=np.eye(3), process=False)
    files = trimesh.exchange.gltf.export_gltf(mesh.scene(), merge_buffers=True)
    tree = json.loads(files["model.gltf"])
    for buffer in tree["buffers"]:
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(files[buffer["uri"]]).decode()
    change(tree)
    return json.dumps(tree).encode()


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """Whole files by their suffix."""
    folder, rng = tmp_path_factory.mktemp("whole"), np.random.default_rng(0)
    found = {suffix: [text.encode()] for suffix, text in TEXTS.items()} | {".gltf": [gltf()], ".glb": []}
    found[".ply"] += [polygons(), polygons("binary_big_endian")]
    surface = Surface(rng.random((9, 3)), np.arange(9).reshape(3, 3), rng.random((9, 3)), rng.random((9, 3)))
    for suffix in found.keys() - {".gltf"}:
        write_mesh(folder / f"a{suffix}", surface)
        found[suffix].append((folder / f"a{suffix}").read_bytes())
    assert found.keys() == FORMATS.keys()
    return found


@pytest.mark.parametrize("suffix", FORMATS)
@settings(max_examples=COUNT * 3, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), which=st.integers(0, 9))
def test_damaged_bytes_are_refused_or_every_index_is_in_its_range(originals, tmp_path, suffix, seed, which):
    path, whole = tmp_path / f"a{suffix}", originals[suffix]
    path.write_bytes(mutations.mutate(whole[which % len(whole)], np.random.default_rng(seed)))
    with bounded(more_bytes=256 << 20):
        try:
            content = read_content(path)
        except InputError as error:
            assert path.name in str(error)
            return
    count = len(content.vertices)
    assert content.faces.size == 0 or 0 <= content.faces.min() <= content.faces.max() < count
    for values in (content.normals, content.colors, content.quality, *content.attributes.values()):
        assert values is None or len(values) == count
    if content.texture is not None:
        assert len(content.texture.materials) == len(content.faces)
        assert content.texture.materials.max(initial=0) < len(content.texture.library)


@pytest.mark.parametrize("suffix", FORMATS)
@given(data=st.binary(max_size=300))
@settings(max_examples=COUNT, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_at_all(tmp_path, suffix, data):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    with bounded(more_bytes=256 << 20):
        try:
            read_content(path)
        except InputError as error:
            assert path.name in str(error)


def huge(tree):
    tree["accessors"][1]["count"] = 300_000_000


def zeros(tree):
    tree["accessors"][1] = {"componentType": 5126, "type": "VEC3", "count": 300_000_000}


def twice(tree):
    tree["nodes"] = [{"children": [1, 1]}, {"mesh": 0}]


def chain(tree):
    tree["nodes"] = [{"mesh": 0, "children": [i + 1]} for i in range(5000)] + [{"mesh": 0}]


DAMAGED = {
    "polygon.ply": polygons(last=999_999_999), "negative.ply": polygons(last=-1),
    "crlf.ply": polygons(first=[0, 1, 2] * 3).replace(b"\n", b"\r\n"), "lost.ply": polygons()[:-9] + polygons()[-8:],
    "polygon.off": b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 999999999\n",
    "minus.off": b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 -7\n",
    "face.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 999999999\n",
    "texture.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/99999 2/1 3/1\n",
    "claims.stl": b" " * 80 + struct.pack("<I", 2**32 - 1) + bytes(100),
    "huge.gltf": gltf(huge), "zeros.gltf": gltf(zeros), "twice.gltf": gltf(twice), "chain.gltf": gltf(chain),
    "sparse.gltf": gltf(lambda tree: tree["accessors"][1].update(sparse={})),
    "draco.gltf": gltf(lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"])),
    "stride.gltf": gltf(lambda tree: tree["bufferViews"][1].update(byteStride=4096)),
    "mesh.gltf": gltf(lambda tree: tree["nodes"][0].update(mesh=3)),
    "offset.gltf": gltf(lambda tree: tree["bufferViews"][1].update(byteOffset=-8))}


@pytest.mark.parametrize("name", DAMAGED)
def test_what_ended_the_process_once_is_refused_everywhere(tmp_path, name, capsys):
    path = tmp_path / name
    path.write_bytes(DAMAGED[name])
    for read in (read_mesh, load_points, check_mesh_file):
        with bounded(more_bytes=1 << 30), pytest.raises(InputError, match=name):
            read(path)
    pytest.importorskip("pymeshlab")
    (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript><FilterScript><filter name="Invert Faces Orientation"/>'
                                    "</FilterScript>")
    assert command_line.run(["script", str(tmp_path / "s.mlx"), "--mesh", str(path), "--output",
                             str(tmp_path / "out.ply"), "--quiet"]) == 2
    assert name in capsys.readouterr().err and not (tmp_path / "out.ply").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name, content, message", [
    ("only.gltf", gltf(lambda tree: tree.pop("meshes") and [node.pop("mesh", None) for node in tree["nodes"]]), ""),
    ("a.3ds", b"MM" + bytes(40), "cannot be loaded by pymeshlab"),
    ("a.nothing", b"", "cannot be loaded by pymeshlab")])
def test_kinds_without_a_reader_are_tried_in_a_child(tmp_path, name, content, message):
    pytest.importorskip("pymeshlab")
    (tmp_path / name).write_bytes(content)
    try:
        check_mesh_file(tmp_path / name)
    except InputError as error:
        assert name in str(error) and message in str(error)
    else:
        assert not message


def test_a_point_cloud_is_no_error(tmp_path):
    text = TEXTS[".ply"].replace("element face 2\n", "element face 0\n").partition("5 0 1")[0]
    (tmp_path / "a.ply").write_text(text)
    assert len(read_content(tmp_path / "a.ply").vertices) == 5 == len(load_points(tmp_path / "a.ply"))
    with pytest.raises(InputError, match="a.ply.*0 faces; a point cloud has to be made a mesh first"):
        read_mesh(tmp_path / "a.ply")
    with pytest.raises(InputError, match="a.ply.*0 faces; a point cloud has to be made a mesh first"):
        check_kept(tmp_path / "out.ply", tmp_path / "a.ply")       # before the work of refine
    pytest.importorskip("pymeshlab")
    check_mesh_file(tmp_path / "a.ply")
