"""Messages speak to the one who reads them: names that are near, words of the command line there and of Python here."""

import ast
import logging
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from support.camera_noise import noisy
from support.here import command
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

import pagas_cl
import pagas_cl.__main__ as command_line
from pagas_cl.app.commands._process import log_to_stderr
from pagas_cl.errors import InputError, NothingRefinedError
from pagas_cl.filters import parameters
from pagas_cl.filters.open3d_frames import read_frames
from pagas_cl.jobs.finished import StoredResult
from pagas_cl.jobs.task import Record
from pagas_cl.result import DepthResult
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View


@pytest.mark.parametrize("name, near", [
    ("splatting.radus", "splatting.radius"), ("radius", "splatting.radius"), ("Voxel", "fusion.voxel"),
    ("fusion.voxle", "fusion.voxel"), ("beta", "solver.beta")])
def test_a_setting_nearly_right_is_named(name, near):
    with pytest.raises(InputError, match=f"nearest one is '{near}"):
        pagas_cl.preset("fast").with_settings(**{name: 1})


@pytest.mark.parametrize("name", ["foo", "x", "fast", "splatting.foo" * 9])
def test_no_setting_is_named_that_has_nothing_to_do_with_it(name):
    with pytest.raises(InputError, match="expected stage.field, of the stages splatting, loss, "):
        pagas_cl.preset("fast").with_settings(**{name: 1})
    with pytest.raises(InputError, match="unknown parameter 'qqqq'; expected one of preset, output"):
        parameters.check_parameter({"name": "qqqq", "type": "RichInt"}, parameters.TYPES, {}, "here")


@pytest.mark.parametrize("values", [{"effects": "exposure"}, {"settings": "splatting.radius"},
                                    {"settings": "splatting.radius=wide"}, {"effects": "foo=on"}])
def test_meshlab_and_python_hear_nothing_of_options(values):
    with pytest.raises(InputError) as caught:
        parameters.request({name: value for name, value in values.items()}, "here")
    assert "--" not in str(caught.value) and str(caught.value).startswith("here")


def test_a_view_without_a_name_leaves_no_gap():
    camera = Camera(8, 6, 10, 10, 4, 3, np.eye(4))
    view = View(camera, np.zeros((6, 8, 3), np.uint8))
    assert view.name == "unnamed" == view.stem
    with pytest.raises(InputError) as caught:
        View(camera, np.zeros((6, 9, 3), np.uint8))
    assert "''" not in str(caught.value) and "  " not in str(caught.value)


def test_a_depth_map_of_another_size_than_its_photo_is_reported_as_that():
    frames = [(np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32)) for _ in range(3)]
    frames[1] = frames[1][0], np.ones((6, 8), np.float32)
    K = [np.eye(3)] * 3
    with pytest.raises(InputError, match="frame 00001: color is 16 x 12 and depth 8 x 6"):
        read_frames(frames, K, [np.eye(4)] * 3)


@pytest.fixture(scope="module")
def inverted(tmp_path_factory):
    """A scene whose files hold camera-to-world poses, and the mesh."""
    pytest.importorskip("open3d")

    made = relief_scene(64, 48, 2, held_out=0)
    folder = write_scene(made, tmp_path_factory.mktemp("messages") / "scene")
    camera_file.write(folder, [replace(view, name=f"{view.name}.png", camera=replace(
        view.camera, world_to_camera=inverse_pose(view.camera.world_to_camera))) for view in made.views])
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("command", ["refine", "check", "analyze", "tradeoff"])
def test_the_command_line_hears_nothing_of_python(inverted, tmp_path, capsys, command):
    more = ["--output", str(tmp_path / "fine.ply")] if command == "refine" else []
    assert command_line.run([command, str(inverted), "--mesh", str(inverted / "mesh_coarse.ply"), *more]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "invert each pose there" in last and "Camera" not in last and "(K" not in last


def test_a_result_prints_as_a_line(tmp_path):
    camera = Camera(4, 3, 10, 10, 2, 1.5, np.eye(4), "a.png")
    result = DepthResult.unrefined(camera, np.ones((3, 4)), "nobody sees it")
    assert repr(result) == "DepthResult('a.png', 4 x 3: 12 kept; unchanged: nobody sees it)"
    stored = StoredResult(camera, tmp_path, Record("a.png", "a", "k", "", {"refined": 12345}))
    assert repr(stored) == "StoredResult('a.png', 4 x 3: 12,345 refined)"


def test_a_scene_has_its_images(inverted):
    scene = pagas_cl.read_scene(inverted)
    assert [image.name for image in scene.images] == ["target.png", "context_00.png", "context_01.png"]


@pytest.mark.parametrize("details", [False, True])
def test_warnings_are_logged_once(capsys, details):
    log = logging.getLogger("pagas_cl")
    with log_to_stderr(details):
        for k in range(20):
            log.warning("the same")
            log.warning("view %s is odd", k)
            log.info("as it is")
        for k in range(6):
            log.warning("photo %s has %d of %.3g", k, k, 0.5)
    lines = capsys.readouterr().err.splitlines()
    assert lines.count("WARNING the same") == (20 if details else 1) and lines.count("INFO as it is") == 20
    assert sum("is odd" in line and "more" not in line for line in lines) == (20 if details else 5)
    assert ("WARNING 15 more warnings like 'view ... is odd' (--verbose shows all)" in lines) == (not details)
    assert ("WARNING 1 more warning like 'photo ... has ... of ...' (--verbose shows all)" in lines) == (not details)


@pytest.mark.parametrize("error, status", [(InputError("the cause"), 2), (NothingRefinedError("the cause"), 3),
                                           (RuntimeError("the cause"), 1), (KeyboardInterrupt(), 130)])
def test_the_cause_is_the_last_line_below_all_warnings(monkeypatch, capsys, error, status):
    def fails(_):
        for k in range(20):
            logging.getLogger("pagas_cl").warning("view %s is odd", k)
        raise error

    monkeypatch.setattr(command_line, "_run", fails)
    assert command_line.run(["refine"]) == status
    *_, rest, last = capsys.readouterr().err.splitlines()
    assert "15 more warnings like" in rest
    assert last.startswith("pagas-cl: ") and ("the cause" in last or "interrupted" in last)


# what the method measures and plans, in its own terms: with --verbose alone
JARGON = ("threshold", "evidence", "epipolar", "residual", "footprint", "vertices", "edges lie", "voxel", "truncation",
          "gaussian", "root mean square", "planned", "device memory", "host memory", " lanes", "contradict",
          "held back", "consistency", "correlation", "OpenCL 3")


@pytest.mark.slow
@pytest.mark.parametrize("off", [0, 1], ids=["cameras right", "cameras off"])
@pytest.mark.parametrize("start", ["mesh", "depth"])
def test_by_default_a_run_speaks_to_a_photographer_and_with_verbose_has_its_figures(tmp_path, device, start, off):
    """As in a pipe, first line to last: few lines, none of the method's terms, what came out and where it is."""
    pytest.importorskip("open3d")
    made = relief_scene(96, 72, 4, held_out=0)
    folder = write_scene(made, tmp_path / "scene")
    if off:
        cameras = noisy([view.camera for view in made.views], off, seed=0)
        camera_file.write(folder, [replace(view, name=f"{view.name}.png", camera=camera)
                                   for view, camera in zip(made.views, cameras)])
    given = ["--mesh", str(folder / "mesh_coarse.ply")] if start == "mesh" else ["--depth-dir",
                                                                               str(folder / "depth_initial")]
    lines = {}
    for more in ((), ("--verbose",)):
        done = command("refine", folder, *given, "--output", tmp_path / "fine.ply", "--set", "pyramid.steps=5", *more)
        assert done.returncode == 0 and not done.stdout, done.stderr
        lines[more] = [line for line in done.stderr.splitlines() if line.startswith(("INFO", "WARNING", "DEBUG"))]
    short, long = lines.values()
    found = [(term, line) for line in short for term in JARGON if term.lower() in line.lower()]
    assert not found and len(short) <= 12 and not any(line.startswith("DEBUG") for line in short)
    assert f"photos: {len(made.views)} of 96 x 72" in short[0]
    assert short[-2].endswith(f"the refined mesh: {tmp_path}/fine.ply") and "photos agree better" in short[-1]
    assert any("The photos refined " in line and " of the surface in " in line for line in short)
    assert any(("corrected" if off else "no error was found") in line for line in short if "cameras" in line)
    assert set(short) <= set(long)
    figures = " ".join(line for line in long if line.startswith("DEBUG"))
    of_mesh = ("host memory",) if start == "mesh" else ()
    assert all(term in figures for term in ("threshold", "epipolar", "device memory", *of_mesh))


# words of our own where the field has one: what (in no sentence that a user reads), and what to say
BANNED = {
    r"told|tells?|ask(s|ed)?( for)?|calls? for|called for": "logged, measured, reported; required, requested",
    "as (it|they) came|came in": "unchanged", "beside|aside": "next to, offset", "elsewhere": "at another place",
    "across the direction of depth|off across depth": "epipolar residual, or: that no depth explains",
    "strays?|lost": "outlier views; failed", "settled?": "resolve, decide", "pieces": "connected components",
    "ours|strangers?": "written by pagas_cl, foreign", "dear|cheap(er)?": "costly, low-cost",
    "silent|spoken": "uninformative, informative", "rungs?|outlook": "preset ladder; (gone)",
    "landing|fading": "projected row range; taper", "bring(s|ing)? .*together|brought together": "align"}


def texts_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Every string of a module with a space in it, but for docstrings: its line, and the text, {} for insertions."""
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, (ast.JoinedStr, ast.Expr))
             for part in (node.values if isinstance(node, ast.JoinedStr) else [node.value])}
    inner -= {id(node.body[0].value) for node in ast.walk(tree)      # of a command the docstring is its help
              if isinstance(node, ast.FunctionDef) and node.name == "command" and isinstance(node.body[0], ast.Expr)}
    for node in ast.walk(tree):
        parts = [node] if isinstance(node, ast.Constant) else node.values if isinstance(node, ast.JoinedStr) else []
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)
        if " " in text and id(node) not in inner:
            yield node.lineno, text


def test_no_sentence_for_users_has_a_word_that_is_banned():
    files = [*(ROOT / "pagas_cl").rglob("*.py"), *(ROOT / "filters").glob("*.py")]
    helps = {file: ast.parse(file.read_text(encoding="utf-8")) for file in sorted(files)}
    banned = re.compile(rf"\b({'|'.join(BANNED)})\b", re.IGNORECASE)
    found = [f"{file.relative_to(ROOT)}:{line}: {word[0]!r} in {text!r}" for file, tree in helps.items()
             for line, text in texts_of(tree) for word in banned.finditer(text)]
    assert not found, "\n".join(found)


def test_whom_a_cluster_trusts_is_said_where_it_is_given(capsys):
    assert command_line.run(["refine", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.replace("\u2502", " ").split())
    assert "one that you trust, since it may run any program here" in text
    assert "pickles, which run code when they are read" in " ".join((ROOT / "docs/usage.md").read_text().split())
