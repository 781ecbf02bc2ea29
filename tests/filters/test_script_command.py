"""`pagas-cl script` as people run it: damaged meshes, places that are inputs, full disks (those in a process of its
own), attributes of files."""

import resource
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pymeshlab = pytest.importorskip("pymeshlab")

from support.here import command  # noqa: E402
from support.scenes import relief_scene  # noqa: E402
from support.synthetic.scene import write_scene  # noqa: E402

from pagas_cl.scene.mesh import Surface  # noqa: E402
from pagas_cl.scene.meshes.files import read_mesh, write_mesh  # noqa: E402
from pagas_cl.scene.meshes.meshlab_layer import CONFIDENCE, read_columns  # noqa: E402
from pagas_cl.scene.readers import read_scene  # noqa: E402
from pagas_cl.scene.readers.meshlab import MeshLayer, read_project, write_project  # noqa: E402

pytestmark = pytest.mark.slow

SMOOTH = ('<filter name="Laplacian Smooth"><Param type="RichInt" name="stepSmoothNum" value="1"/></filter>')
PAGAS_STEP = ('<filter name="PAGaS Depth Refinement"><Param type="RichString" name="settings" value="pyramid.steps=8"/>'
        '</filter>')


def run(*arguments, limit: int | None = None):
    """The command's status and standard error; no file of more than `limit` bytes can be written."""
    def limited():
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    done = subprocess.run([sys.executable, "-m", "pagas_cl", "script", *map(str, arguments)], capture_output=True,
                          text=True, timeout=120, check=False, preexec_fn=limited)
    assert "Traceback" not in done.stderr and done.stdout == "", done
    return done.returncode, done.stderr


def run_here(*arguments):
    """The same within this process, which takes a fraction of the time."""
    done = command("script", *arguments)
    return done.returncode, done.stderr


@pytest.fixture
def place(tmp_path):
    (tmp_path / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{SMOOTH}</FilterScript>\n")
    return tmp_path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "SCENE"
    write_scene(relief_scene(64, 48, contexts=2, held_out=0, steps=0), folder)
    return folder


def sphere(path: Path, subdivisions: int = 3) -> Path:
    meshes = pymeshlab.MeshSet()
    meshes.create_sphere(subdiv=subdivisions)
    mesh = meshes.current_mesh()
    write_mesh(path, Surface(mesh.vertex_matrix(), mesh.face_matrix()))
    return path


# -- meshes that pymeshlab must not be handed -----------------------------------------------------------------------

_PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
_FACE = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
DAMAGED = {
    "polygon.ply": _PLY + _FACE + np.zeros((4, 3), "<f4").tobytes() + struct.pack("<B4i", 4, 0, 1, 2, 99_999_999),
    "negative.ply": _PLY + _FACE + np.zeros((4, 3), "<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, -7),
    "short.ply": _PLY + _FACE + bytes(9),
    "index.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2 99999999\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 999999999\n",
    "claims.stl": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50),
}


@pytest.mark.parametrize("name, by_project", [(name, name in ("polygon.ply", "claims.stl")) for name in DAMAGED])
def test_damaged_meshes_are_refused(place, name, by_project):
    (place / name).write_bytes(DAMAGED[name])
    sources = [["--mesh", place / name]]
    if by_project:
        project = write_project(place / "p.mlp", [], [MeshLayer("x", place / name, np.eye(4))])
        sources.append(["--project", project])
    for source in sources:
        status, message = run_here(place / "s.mlx", *source, "--output", place / "out.ply")
        assert status == 2 and name in message.splitlines()[-1], message
        assert not (place / "out.ply").exists()


# -- places that are inputs, or belong to others --------------------------------------------------------------------


def test_no_output_is_an_input_and_none_replaces_foreign_files(place, scene):
    mesh, script, linked = sphere(place / "m.ply"), place / "s.mlx", place / "link.ply"
    linked.symlink_to(mesh)
    photo = sorted((scene / "images").iterdir())[0]
    foreign = place / "foreign.ply"
    foreign.write_bytes(DAMAGED["short.ply"])
    out = place / "out.ply"
    trials = [({"--output": mesh}, "--mesh"), ({"--output": linked}, "--mesh"), ({"--save-script": mesh}, "--mesh"),
              ({"--save-script": script}, "the script"), ({"--save-script": photo}, "photo"),
              ({"--save-script": out}, "--output"), ({"--output": foreign}, "--overwrite")]
    kept = {path: path.read_bytes() for path in (mesh, script, photo, foreign)}
    for given, word in trials:
        options = {"--output": out, **given}
        for more in ([], ["--overwrite"]) if word != "--overwrite" else ([],):
            status, message = run_here(script, scene, "--mesh", mesh, *(x for o in options.items() for x in o), *more)
            assert status == 2 and word in message.splitlines()[-1], (given, message)
            assert all(path.read_bytes() == content for path, content in kept.items()) and not out.exists()
    assert run_here(script, "--mesh", mesh, "--output", foreign, "--overwrite")[0] == 0
    assert foreign.read_bytes() != kept[foreign]


@pytest.mark.parametrize("kind", ["ply", "obj", "off", "stl", "mlp"])
def test_what_pagas_cl_wrote_is_replaced(place, kind):
    mesh = sphere(place / "m.ply")
    for _ in range(2):
        assert run_here(place / "s.mlx", "--mesh", mesh, "--output", place / f"o.{kind}", "--save-script",
                        place / "h.mlx")[0] == 0
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(place / "o.mlp")) if kind == "mlp" else meshes.load_new_mesh(str(place / f"o.{kind}"))
    assert meshes.current_mesh().face_number() > 100
    (place / "o_0.ply").write_bytes(b"mine")
    if kind == "mlp":
        assert run_here(place / "s.mlx", "--mesh", mesh, "--output", place / "o.mlp")[0] == 2
        assert (place / "o_0.ply").read_bytes() == b"mine"


def test_a_project_does_not_write_over_its_layers(place):
    layer = sphere(place / "out_0.ply")
    project = write_project(place / "p.mlp", [], [MeshLayer("x", layer, np.eye(4))])
    content = layer.read_bytes()
    for output in ("out.mlp", "p.mlp", "out_0.ply"):
        status, message = run_here(place / "s.mlx", "--project", project, "--output", place / output, "--overwrite")
        assert status == 2 and "which is read" in message, message
    assert layer.read_bytes() == content


def test_hidden_layers_stay_hidden(place):
    """Filters of visible layers leave them out, and a project that is written has them hidden."""
    (place / "s.mlx").write_text('<!DOCTYPE FilterScript>\n<FilterScript><filter name="Flatten Visible Layers"/>'
                                 "</FilterScript>\n")
    layers = [MeshLayer(name, sphere(place / f"{name}.ply", 1), np.eye(4), name != "b") for name in "abc"]
    count = len(read_mesh(layers[0].path).faces)
    project = write_project(place / "p.mlp", [], layers)
    assert run_here(place / "s.mlx", "--project", project, "--output", place / "o.ply")[0] == 0
    assert len(read_mesh(place / "o.ply").faces) == 2 * count
    (place / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{SMOOTH}</FilterScript>\n")
    assert run_here(place / "s.mlx", "--project", project, "--output", place / "o.mlp")[0] == 0
    assert [layer.visible for layer in read_project(place / "o.mlp").meshes] == [True, False, True]


def test_a_project_is_written_of_the_layers_that_are_left(place):
    """pymeshlab counts on where a layer is deleted: its error came after the work, and nothing was written."""
    layers = [MeshLayer(name, sphere(place / f"{name}.ply", n), np.eye(4)) for n, name in enumerate("abc")]
    (place / "s.mlx").write_text('<!DOCTYPE FilterScript>\n<FilterScript><filter name="Delete Current Mesh"/>'
                                 "</FilterScript>\n")
    project = write_project(place / "p.mlp", [], layers)
    arguments = place / "s.mlx", "--project", project, "--layer", "a", "--output", place / "o.mlp"
    status, said = run_here(*arguments)
    assert status == 0, said
    left = read_project(place / "o.mlp").meshes
    assert [layer.label for layer in left] == ["b", "c"]
    assert [len(read_mesh(layer.path).faces) for layer in left] == [len(read_mesh(e.path).faces) for e in layers[1:]]
    for output in ("x.ply", "x.mlp"):
        status, said = run_here(place / "s.mlx", "--mesh", layers[0].path, "--output", place / output)
        assert status == 2 and "leaves no layer that could be written" in said, said


def test_of_a_matrix_that_a_mesh_file_has_no_place_for_it_is_said(place):
    project = write_project(place / "p.mlp", [], [MeshLayer("x", sphere(place / "x.ply", 1), np.diag([2.0, 2, 2, 1]))])
    for output, said in (("o.ply", True), ("o.mlp", False)):
        status, message = run_here(place / "s.mlx", "--project", project, "--output", place / output)
        assert status == 0 and ("the layer 'x' without its matrix" in message) == said, message


def test_a_project_without_photos_takes_those_of_a_scene(place, scene):
    (place / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{PAGAS_STEP}</FilterScript>\n")
    scene = Path(shutil.copytree(scene, place / "SCENE"))
    layer, views = MeshLayer("x", scene / "mesh_coarse.ply", np.eye(4)), read_scene(scene).views
    project = write_project(scene / "without.mlp", [], [layer])
    arguments = "--project", project, "--output", place / "o.ply"
    assert "needs a scene" in run_here(place / "s.mlx", *arguments)[1]
    assert run_here(place / "s.mlx", scene, *arguments)[0] == 0
    write_project(project, views, [layer])
    status, message = run_here(place / "s.mlx", scene, *arguments)
    assert status == 2 and "which brings its own photos: give one of them" in message, message


# -- full disks -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ply", "obj", "x3d", "mlp"])
def test_a_full_disk_is_one_sentence_and_leaves_nothing(place, kind):
    mesh, output = sphere(place / "m.ply", 6), place / "new" / f"o.{kind}"
    status, message = run(place / "s.mlx", "--mesh", mesh, "--output", output, limit=100_000)
    assert status == 1 and message.splitlines()[-1].startswith("pagas-cl: cannot write"), message
    assert "PyMeshLab" not in message and "File too large" in message
    assert not list((place / "new").iterdir()) and mesh.is_file()


def test_a_history_that_does_not_fit_leaves_none(place):
    (place / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{SMOOTH * 1000}</FilterScript>\n")
    mesh = sphere(place / "m.ply", 1)
    status, message = run(place / "s.mlx", "--mesh", mesh, "--output", place / "o.ply", "--save-script",
                          place / "h.mlx", limit=70_000)
    assert status == 1 and "File too large" in message and not (place / "h.mlx").exists(), message[-300:]


# -- what files hold ------------------------------------------------------------------------------------------------


def with_columns(path: Path, scene: Path, kind: str = "<f4") -> Path:
    """The scene's coarse mesh with numbers of vertices and faces of its own."""
    given, word = read_columns(scene / "mesh_coarse.ply"), {"<f4": "float", "<f8": "double", "<i4": "int"}[kind]
    count, faces = len(given.vertex["x"]), len(given.face["vertex_indices"])
    vertices = np.empty(count, [(axis, "<f8") for axis in "xyz"] + [("scalar_Age", kind), ("confidence", "<f4")])
    for axis in "xyz":
        vertices[axis] = given.vertex[axis]
    vertices["scalar_Age"], vertices["confidence"] = np.arange(count), np.linspace(0.5, 1, count)
    table = np.empty(faces, [("n", "u1"), ("i", "<i4", 3), ("part", kind)])
    table["n"], table["i"], table["part"] = 3, given.face["vertex_indices"], np.arange(faces)
    path.write_bytes((f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty double x\n"
                      f"property double y\nproperty double z\nproperty {word} scalar_Age\nproperty float confidence\n"
                      f"element face {faces}\nproperty list uchar int vertex_indices\nproperty {word} part\n"
                      "end_header\n").encode() + vertices.tobytes() + table.tobytes())
    return path


@pytest.mark.parametrize("kind", ["<f4", "<f8", "<i4"])
def test_attributes_of_a_ply_come_along(place, scene, kind):
    mesh = with_columns(place / "m.ply", scene, kind)
    (place / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{SMOOTH}{PAGAS_STEP}</FilterScript>\n")
    status, message = (run if kind == "<f4" else run_here)(place / "s.mlx", scene, "--mesh", mesh, "--output",
                                                        place / "o.ply", "--quiet")
    expected = ("no graphics card", *(() if kind == "<f4" else ("FilterScript", "Reading filter")))   # Qt's, here
    lines = [line for line in message.splitlines() if not any(text in line for text in expected)]
    assert (status, lines) == (0, []), message
    old, new = read_columns(mesh), read_columns(place / "o.ply")
    count = len(old.vertex["x"])
    assert np.array_equal(new.vertex["scalar_Age"][:count], np.arange(count))
    assert np.array_equal(new.vertex["quality"][:count], old.vertex["confidence"])
    assert set(new.face["part"]) == set(range(len(old.face["part"]))) and len(new.face["part"]) > len(old.face["part"])
    assert 0 <= new.vertex[CONFIDENCE].min() < new.vertex[CONFIDENCE].max() <= 1


def test_the_photos_of_a_scene_may_be_elsewhere(place, scene):
    pytest.importorskip("pycolmap")
    from pagas_cl.method.cameras.model import write_model

    views = read_scene(scene).views
    write_model(place / "none", views, [view.camera for view in views], place / "colmap")
    (place / "s.mlx").write_text(f"<!DOCTYPE FilterScript>\n<FilterScript>{PAGAS_STEP}</FilterScript>\n")
    arguments = place / "s.mlx", place / "colmap", "--mesh", scene / "mesh_coarse.ply", "--output", place / "o.ply"
    status, message = run_here(*arguments)
    assert status == 2 and "in the folder of --photos" in message
    status, message = run_here(*arguments, "--photos", scene / "images")
    assert status == 0 and (place / "o.ply").exists(), message


def test_what_a_kind_of_file_has_no_place_for_is_named(place, scene):
    mesh = with_columns(place / "m.ply", scene)
    status, message = run_here(place / "s.mlx", "--mesh", mesh, "--output", place / "o.obj")
    assert status == 0
    expected = ("'scalar_Age'", "'confidence'", "'part'", "vertex quality", "a .ply has")
    assert all(word in message for word in expected), message


@pytest.mark.parametrize("kind, status", [("ply", 0), ("obj", 0), ("off", 0), ("stl", 2), ("x3d", 2), ("ctm", 2)])
def test_map_coordinates_are_written_whole_or_refused(place, kind, status):
    surface = Surface(*relief_scene(64, 48, 2, held_out=0).initial_mesh(6.0))
    write_mesh(place / "m.ply", Surface(surface.vertices * 0.01 + [500000.0, 5400000.0, 0], surface.faces))
    got, message = run_here(place / "s.mlx", "--mesh", place / "m.ply", "--output", place / f"o.{kind}")
    assert got == status and (status == 0 or "too few digits" in message), message
    if status == 0:
        meshes = pymeshlab.MeshSet()
        meshes.load_new_mesh(str(place / f"o.{kind}"))
        assert len(np.unique(meshes.current_mesh().vertex_matrix()[:, 1])) > 100


# -- textures -------------------------------------------------------------------------------------------------------

def textured(folder: Path, texture: str, red: int = 200) -> Path:
    """A triangle with a texture that is not encoded as pymeshlab would."""
    (folder / texture).parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (50, 50), (red, 9, 9)).save(folder / texture, compress_level=0)
    (folder / "m.mtl").write_text(f"newmtl a\nmap_Kd {texture}\n")
    (folder / "m.obj").write_text("mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
                                  "f 1/1 2/2 3/3\n")
    return folder / "m.obj"


@pytest.mark.parametrize("output", ["fine.obj", "fine.mlp"])
def test_a_texture_next_to_the_output_stays_as_it_is(place, output):
    mesh = textured(place, "skin.png")
    before = (place / "skin.png").read_bytes()
    status, said = run_here(place / "s.mlx", "--mesh", mesh, "--output", place / output)
    assert status == 0 and (place / output).is_file(), said
    assert (place / "skin.png").read_bytes() == before


@pytest.mark.parametrize("output", ["fine.ply", "fine.obj", "fine.mlp"])
def test_a_texture_in_a_folder_next_to_the_mesh_gets_there(place, output):
    """After the work "Is a directory" was said, and the mesh was lost."""
    mesh = textured(place / "in", "tex/skin.png")
    status, said = run_here(place / "s.mlx", "--mesh", mesh, "--output", place / "out" / output)
    assert status == 0, said
    assert {str(file.relative_to(place / "out")) for file in (place / "out").rglob("*.*")} >= {output, "tex/skin.png"}
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(next(file for file in (place / "out").iterdir() if file.suffix in (".ply", ".obj"))))
    assert list(meshes.current_mesh().textures()) == ["tex/skin.png"]
    other = place / "taken" / output
    textured(place / "taken", "tex/skin.png", red=7)
    status, said = run_here(place / "s.mlx", "--mesh", mesh, "--output", other)
    assert status == 1 and "tex/skin.png is there and was not written by pagas_cl" in said and not other.exists(), said
    assert len(list(place.glob("taken/fine*~*/tex/skin.png"))) == 1


def test_textures_of_two_layers_that_would_be_one_file(place):
    """After the work one of them was said to be another program's."""
    meshes = [textured(place / name, "skin.png", red) for name, red in (("a", 9), ("b", 200), ("c", 200))]
    for chosen, status in ((meshes, 2), (meshes[1:], 0)):
        project = write_project(place / "p.mlp", [], [MeshLayer(m.parent.name, m, np.eye(4)) for m in chosen])
        done = run_here(place / "s.mlx", "--project", project, "--output", place / f"out{status}" / "o.mlp")
        assert done[0] == status, done
        assert status == 0 or "b/skin.png would be one file next to the project" in done[1] and not (
            place / "out2").exists(), done


def test_a_texture_out_of_the_folder_of_its_mesh_is_not_written(place):
    """It was written next to the folder of the output, over whatever had its name there."""
    mesh = textured(place / "in", "../tex/skin.png")
    mine = textured(place / "out", "tex/skin.png", red=7).parent / "tex" / "skin.png"
    before = mine.read_bytes()
    status, said = run_here(place / "s.mlx", "--mesh", mesh, "--outside", "--output", place / "out" / "fine.ply")
    assert status == 2 and "put the texture next to the mesh" in said, said
    assert mine.read_bytes() == before


def test_a_texture_that_pymeshlab_does_not_read_is_named(place):
    mesh = textured(place, "skin.png")
    (place / "skin.png").unlink()
    said = run_here(place / "s.mlx", "--mesh", mesh, "--output", place / "fine.obj")[1]
    assert f"not kept: textures of {mesh} that are missing or that pymeshlab does not read" in said
