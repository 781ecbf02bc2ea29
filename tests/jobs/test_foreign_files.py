"""Files that pagas_cl has not written, next to and below every place that a command writes to, are the same afterwards,
whether it ended well, was refused, or was killed; finished views that somebody has changed are not believed; two runs
at once."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support.job_scenes import NOT_MEASURED, QUICK, bytes_of, load_small_scene, said, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.app.report import picture_files
from pagas_cl.app.report.page import html_page
from pagas_cl.errors import InputError, OutputError
from pagas_cl.refine import refine_views
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.depthmap import load_depth, save_depth
from pagas_cl.scene.names import OWN
from pagas_cl.system.files import replaced

pytestmark = pytest.mark.slow

FOREIGN = ("notes.txt", ".a.part", ".target.npz.other-7.part", ".fine.ply.other-7.part.ply", "mine.npz",
             ".hidden/x.part", ".work/journal/a.txt", ".work/inputs/a.npy", ".work/stop", "inputs/a.npy",
             "journal/a.txt", "views/a.json", ".fine.ply.views/mine.txt", ".fine.ply.views/.work/a.json",
             ".fusion-a/blocks.npy", "left/target.npz", "fine.mtl", "fine_0.png", "fine.obj.mtl", "stop", "lock",
             "names.json")
SETTINGS = ("--set", "pyramid.steps=3", "--context", "3", "--quiet", *NOT_MEASURED)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("foreign") / "scene")


def put_foreign_files(*folders) -> dict:
    """Foreign files in folders, and a link out of each; their content."""
    for folder in folders:
        for name in FOREIGN:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(f"somebody's {name}")
        (folder / "link").symlink_to(folder / "notes.txt")
    return theirs(*folders)


def theirs(*folders) -> dict:
    paths = [folder / name for folder in folders for name in (*FOREIGN, "link")]
    return {str(path): (path.is_symlink(), path.read_bytes()) if path.exists() else None for path in paths}


def commands(scene, out, depths) -> dict:
    """Every command that writes, each with outputs in `out` and one folder below."""
    mesh = ("--mesh", str(scene / "mesh_coarse.ply"))
    from_depths = ("--depth-dir", str(depths))
    views = ("--views", "target", "context_00", "context_01")
    return {
        "depth": ("refine", str(scene), *from_depths, "--save-depth", str(out), *SETTINGS, *views),
        "report": ("refine", str(scene), *from_depths, "--report", str(out), *SETTINGS, "--views", "target"),
        "mesh": ("refine", str(scene), *mesh, "--output", str(out / "fine.ply"), *SETTINGS, *views),
        "fused": ("refine", str(scene), *mesh, "--output", str(out / "fine.ply"), "--fuse", *SETTINGS, *views),
        "object": ("refine", str(scene), *mesh, "--output", str(out / "fine.obj"), *SETTINGS, *views),
        "kept": ("refine", str(scene), *mesh, "--output", str(out / "fine.ply"), "--keep-mesh", *SETTINGS, *views),
        "demo": ("demo", "--output", str(out), "--width", "64", "--context", "2", "--quiet"),
        "analyze": ("analyze", str(scene), *from_depths, "--json", str(out / "a.json"),
                    "--views", "target", "--no-costs", "--quiet"),
        "cameras": ("cameras", str(scene), *from_depths, "--output", str(out), "--quiet"),
        "evaluate": ("evaluate", str(depths), str(depths), "--scene", str(scene), "--json", str(out / "e.json")),
    }


@pytest.mark.parametrize("name", ["depth", "report", "mesh", "fused", "object", "kept", "demo", "analyze", "cameras",
                                  "evaluate"])
def test_foreign_files_stay_as_they_are(scene, tmp_path, name):
    pytest.importorskip("open3d")
    out = tmp_path / "a" / "out"
    before = put_foreign_files(out, out.parent)
    command = commands(scene, out, scene / "depth_initial")[name]
    assert command_line.run(list(command)) == 0
    assert theirs(out, out.parent) == before
    assert not [path for path in out.rglob("*") if ".part" in path.name and str(path) not in before]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_foreign_files_stay_where_a_run_is_killed(scene, tmp_path, how):
    """Killed once a view is finished, or a little later, then run to its end."""
    out = tmp_path / "a" / "out"
    before = put_foreign_files(out, out.parent)
    command = [*commands(scene, out, scene / "depth_initial")["depth"], "--set", "pyramid.steps=60"]
    process = subprocess.Popen([sys.executable, "-m", "pagas_cl", *command], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not bytes_of(out).keys() - {"mine.npz"} and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(how)
    process.wait(60)
    assert theirs(out, out.parent) == before
    assert command_line.run(command) == 0
    assert theirs(out, out.parent) == before and len(bytes_of(out)) == 4


def test_a_depth_map_of_somebody_else_is_not_replaced(scene, tmp_path, capsys):
    save_depth(tmp_path / "target.npz", np.full((48, 64), 7))
    command = commands(scene, tmp_path, scene / "depth_initial")["depth"]
    assert command_line.run(list(command)) == 2
    assert "target.npz' is there and was not written by pagas_cl" in capsys.readouterr().err
    assert (load_depth(tmp_path / "target.npz") == 7).all() and not (tmp_path / "context_00.npz").exists()
    (tmp_path / "target.npz").unlink()
    assert command_line.run(list(command)) == 0 == command_line.run(list(command))


def test_a_page_of_somebody_else_is_not_replaced(scene, tmp_path, capsys):
    (tmp_path / "index.html").write_text("<html>my own page</html>")
    command = commands(scene, tmp_path, scene / "depth_initial")["report"]
    assert command_line.run(list(command)) == 2
    assert "index.html' is there and was not written by pagas_cl" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    (tmp_path / "index.html").unlink()
    assert command_line.run(list(command)) == 0 == command_line.run(list(command))


def test_pages_of_two_commands_do_not_replace_each_other(scene, tmp_path, capsys):
    page = html_page("any", [], [], [])
    refine = commands(scene, tmp_path, scene / "depth_initial")["report"]
    study = ["tradeoff", str(scene), "--depth-dir", str(scene / "depth_initial"), "--report", str(tmp_path)]
    (tmp_path / "tradeoff.png").write_text("mine")
    assert command_line.run(study) == 2
    assert "tradeoff.png' is there and was not written by pagas_cl" in capsys.readouterr().err
    (tmp_path / "tradeoff.json").write_text("{}")
    (tmp_path / "index.html").write_text(page)
    assert command_line.run(list(refine)) == 2 and "is the page of another command" in capsys.readouterr().err
    assert (tmp_path / "index.html").read_text() == page and (tmp_path / "tradeoff.png").read_text() == "mine"


def test_a_picture_of_somebody_else_is_not_replaced(scene, tmp_path, capsys, monkeypatch):
    """Of exactly a name that pagas_cl would give; others stay, and what an earlier run has written or begun may
    be replaced."""
    (tmp_path / "target_other.png").write_text("theirs")
    meshes = ("--mesh", str(scene / "mesh_coarse.ply"), "--output", str(tmp_path / "m" / "fine.ply"), "--keep-mesh")
    refine = ["refine", str(scene), *meshes, "--report", str(tmp_path), "--views", "target", *SETTINGS]
    for file in ("target_change.png", "target_photo.jpg", "mesh_photo.jpg", "report.json"):
        (tmp_path / file).write_text("{}")
        assert command_line.run(list(refine)) == 2
        assert f"{file}' is there and was not written by pagas_cl" in capsys.readouterr().err
        assert (tmp_path / file).read_text() == "{}" and len(list(tmp_path.iterdir())) == 2
        (tmp_path / file).unlink()
    for killed in (True, False, False):
        with monkeypatch.context() as patched:
            if killed:
                patched.setattr("pagas_cl.app.report.Report.write", lambda report: None)
            assert command_line.run(list(refine)) == 0
    pictures = {path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".jpg")} - {"target_other.png"}
    cameras_stayed = {"target_camera.png"}
    assert pictures == set(picture_files(["target.png"], meshes=True)) - cameras_stayed
    assert (tmp_path / "target_other.png").read_text() == "theirs" and not (tmp_path / OWN).exists()


def test_a_model_of_somebody_else_is_not_replaced(scene, tmp_path, capsys):
    """The scene's own, say, where --output names the scene."""
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/images.bin").write_text("precious")
    assert command_line.run(list(commands(scene, tmp_path, scene / "depth_initial")["cameras"])) == 2
    assert "is of a model that pagas_cl has not written" in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["sparse", "0", "images.bin"]
    assert (tmp_path / "sparse/0/images.bin").read_text() == "precious"


def test_what_is_started_from_is_not_replaced(scene, tmp_path, capsys):
    depths, mesh = tmp_path / "depths", tmp_path / "m.ply"
    shutil.copytree(scene / "depth_initial", depths)
    shutil.copy(scene / "mesh_coarse.ply", mesh)
    (tmp_path / "same").symlink_to(depths)
    before = bytes_of(depths), mesh.read_bytes()
    for given in (("--depth-dir", str(depths), "--save-depth", str(tmp_path / "same")),
                  ("--mesh", str(mesh), "--output", str(mesh))):
        assert command_line.run(["refine", str(scene), *given, *SETTINGS]) == 2
        assert f"is {given[0]}, which is read: choose another name" in capsys.readouterr().err
    views, _ = load_small_scene(scene)
    with pytest.raises(InputError, match="choose another folder"):
        refine_views(views, [DepthSource(depths / f"{view.stem}.npz", (64, 48)) for view in views], config=QUICK,
                     folder=depths)
    assert (bytes_of(depths), mesh.read_bytes()) == before


def test_a_part_is_written_behind_no_link(tmp_path, monkeypatch):
    """In a folder of several users somebody else may have put a link where we are about to write."""
    (tmp_path / "victim").write_text("precious")
    tokens = iter(["0" * 12, "1" * 12])
    monkeypatch.setattr("secrets.token_hex", lambda _: next(tokens))
    (tmp_path / f".fine.ply.{'0' * 12}.part").symlink_to(tmp_path / "victim")
    with pytest.raises(OutputError), replaced(tmp_path / "fine.ply") as temporary:
        temporary.write_text("made")
    with replaced(tmp_path / "fine.ply") as temporary:
        temporary.write_text("made")
    assert (tmp_path / "victim").read_text() == "precious" and (tmp_path / "fine.ply").read_text() == "made"


def test_ctrl_c_while_a_file_is_made_leaves_nothing(tmp_path, monkeypatch):
    """A disk that is busy takes long to make it, and Ctrl-C comes then."""
    made = os.open

    def interrupted(*arguments):
        os.close(made(*arguments))
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "open", interrupted)
    with pytest.raises(KeyboardInterrupt), replaced(tmp_path / "view.png"):
        pass
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())


# -- finished views that somebody has changed ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def undisturbed(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    views, depths = load_small_scene(scene)
    refine_views(views, depths, config=QUICK, folder=folder)
    return folder


def halved(path):
    with np.load(path) as archive:
        arrays = {name: values / 2 if values.dtype.kind == "f" else values for name, values in archive.items()}
    with open(path, "wb") as file:
        np.savez(file, **arrays)


def one_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def zeros(path):
    path.write_bytes(bytes(path.stat().st_size))


def another(path):
    shutil.copy(path.with_name(f"context_06{path.suffix}"), path)


def nested(path):
    path.write_text("[" * 100_000)


def swapped(path):
    path.write_text(path.read_text().replace(': 0', ': 1', 1))


def cut(path):
    os.truncate(path, 100)


def gone(path):
    path.unlink()


DEPTH, MORE, RECORD = "{}.npz", ".pagas_cl/views/{}.npz", ".pagas_cl/views/{}.json"
CHANGES = [[(DEPTH, halved), (DEPTH, one_bit), (MORE, halved), (MORE, one_bit), (RECORD, one_bit), (RECORD, nested)],
           [(DEPTH, zeros), (DEPTH, another), (MORE, zeros), (MORE, another), (RECORD, another), (RECORD, swapped)],
           [(DEPTH, cut), (DEPTH, gone), (MORE, cut), (MORE, gone), (RECORD, zeros), (RECORD, gone)]]


@pytest.mark.parametrize("changes", CHANGES)
def test_a_finished_view_with_other_bytes_is_refined_anew(scene, undisturbed, tmp_path, changes):
    out = shutil.copytree(undisturbed, tmp_path / "out")
    views, depths = load_small_scene(scene)
    for view, (file, change) in zip(views, changes):
        change(out / file.format(view.stem))
    results = refine_views(views, depths, config=QUICK, folder=out)
    assert sorted(said(out, "began")) == sorted(view.name for view in views[:6])
    assert bytes_of(out) == bytes_of(undisturbed) and all(result.confidence.any() for result in results)


def test_what_is_missing_is_made_and_what_is_there_is_kept(scene, tmp_path, capsys):
    """Depth maps first; then pictures, a fused mesh and the given mesh moved, without refining anything again."""
    pytest.importorskip("open3d")
    out = tmp_path / "out"
    command = ["refine", str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--save-depth", str(out), *SETTINGS]
    assert command_line.run(command) == 0 and len(said(out, "began")) == 8
    before = bytes_of(out)
    for more in (["--report", "page"], ["--output", "fused.ply", "--fuse"], ["--output", "fine.ply"],
                 ["--output", "kept.ply", "--keep-mesh"],
                 ["--output", "split.ply", "--keep-mesh", "--subdivide", "4", "--report", "more"]):
        given = [str(tmp_path / word) if word[0] != "-" and not word.isdigit() else word for word in more]
        assert command_line.run([*command, *given]) == 0
        assert not said(out, "began") and bytes_of(out) == before and Path(given[1]).exists()
    assert len(list((tmp_path / "page").glob("*_confidence.png"))) == 8
    assert "triangles cross others" in (tmp_path / "more" / "report.json").read_text()
