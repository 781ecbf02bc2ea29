"""Materials, textures and buffers that a mesh file names: pipes, devices, and what lies outside, are not read."""

import json
import os
import shutil

import pytest
from PIL import Image
from support.clouds import load_points
from support.fuzzing import bounded
from support.job_scenes import write_small_scene
from test_pipes import LINKS

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError
from pagas_cl.scene.meshes.files import check_mesh_file, read_content, read_mesh

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")]
OBJ = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl p\nf 1/1 2/2 3/3\n"
PLY = ("ply\nformat ascii 1.0\ncomment TextureFile {}\nelement vertex 3\nproperty float x\nproperty float y\nproperty "
       "float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")


def gltf(name, escaped=False, part="images"):
    """As text, its uri with every letter written as its code point where `escaped`."""
    text = json.dumps({"asset": {"version": "2.0"}, part: [{"uri": "NAME", "byteLength": 4}]})
    code = "".join(f"\\u{ord(letter):04x}" for letter in name)
    return text.replace("NAME", code if escaped else json.dumps(name)[1:-1].replace("/", "\\/"))


def mesh(folder, kind, name):
    """A mesh in `folder` that names the file `name`, by a line of `kind`; its path."""
    suffix = {"buffer": "gltf", "uri": "gltf", "escaped": "gltf", "percent": "gltf", "texture": "ply"}.get(kind, "obj")
    text = {"mtllib": OBJ.format(name), "several": OBJ.format(f"none.mtl {name}"), "texture": PLY.format(name),
            "continued": OBJ.format(f"none.mtl \\\n {name}"), "returns": OBJ.format(f"\\\r\n{name}"),
            "uri": gltf(name), "buffer": gltf(name, part="buffers"), "escaped": gltf(name, True),
            "percent": gltf(name.replace("a", "%61").replace(".", "%2e"))
            }.get(kind, OBJ.format("my m.mtl"))
    (folder / f"a.{suffix}").write_text(text)
    (folder / "my m.mtl").write_text(f"newmtl p\n{kind} {name}\n")
    return folder / f"a.{suffix}"


KINDS = ("mtllib", "several", "continued", "returns", "texture", "uri", "buffer", "escaped", "percent", "map_Kd",
         "map_Kd -s 1 1 1", "\tbump -bm 0.2", "map_Kd \\\n", "map_Ks with space")


@pytest.mark.parametrize("kind", KINDS)
def test_no_file_that_a_mesh_names_is_waited_for_or_has_no_end(tmp_path, kind):
    name = "with space part" if "space" in kind else "part"
    for link in ("pipe", "zeros", "system"):
        LINKS[link](tmp_path / name)
        path = mesh(tmp_path, kind.removesuffix(" with space"), name)
        for read in (read_mesh, load_points):
            with bounded(more_bytes=1 << 30), pytest.raises(InputError, match="no regular file|more than the 0 bytes"):
                read(path)
        (tmp_path / name).unlink()


@pytest.mark.parametrize("kind", KINDS[:-1])
def test_what_lies_outside_is_read_only_where_that_is_allowed(tmp_path, kind):
    (tmp_path / "in" / "parts").mkdir(parents=True)
    for folder in (tmp_path, tmp_path / "in" / "parts"):
        Image.new("RGB", (4, 4)).save(folder / "a.png")
    for name in ("../a.png", str(tmp_path / "a.png")):
        path = mesh(tmp_path / "in", kind, name)
        with pytest.raises(InputError, match="leads out of .*--outside"):
            read_content(path, outside=False)
        with pytest.raises(InputError, match="leads out of .*--outside"):
            check_mesh_file(path)
        read_content(path)
    for name in ("parts/a.png", "parts/../parts/a.png", "none.png", "parts", "0.5", "n" * 300):
        path = mesh(tmp_path / "in", kind, name)
        if kind != "buffer" or name.endswith("a.png"):
            read_content(path, outside=False)
            continue
        with pytest.raises(InputError, match="which is not there"):
            read_content(path, outside=False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("parts") / "scene", 2)


@pytest.mark.parametrize("command", ["refine", "check", "analyze", "tradeoff", "cameras", "script"])
def test_commands_ask_for_outside(scene, tmp_path, capsys, command):
    pytest.importorskip("open3d")
    path = mesh(tmp_path, "map_Kd", "../wood.png")
    (tmp_path.parent / "wood.png").write_bytes(b"")
    (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript><FilterScript><filter name="Invert Faces Orientation"/>'
                                    "</FilterScript>")
    more = {"refine": ["--output", "out.obj"], "cameras": ["--output", "out"], "script": ["--output", "out.ply"]}
    start = [command, str(tmp_path / "s.mlx" if command == "script" else scene)]
    given = [str(tmp_path / word) if word.startswith("out") else word for word in more.get(command, [])]
    assert command_line.run([*start, "--mesh", str(path), *given]) == 2
    assert "'../wood.png', which leads out of" in capsys.readouterr().err and not list(tmp_path.glob("out*"))
    (tmp_path.parent / "wood.png").unlink()


def test_a_pipe_next_to_the_photos_is_no_mesh(scene, tmp_path, capsys):
    """Where no mesh is named one is looked for."""
    folder = shutil.copytree(scene, tmp_path / "scene", ignore=shutil.ignore_patterns("*.ply", "depth*"))
    os.mkfifo(folder / "a.ply")
    (folder / "b.ply").symlink_to("/dev/zero")
    with bounded():
        assert command_line.run(["check", str(folder)]) == 2
    assert "neither depth maps nor a mesh" in capsys.readouterr().err
