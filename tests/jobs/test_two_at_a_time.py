"""Two runs with one place to write to at a time: the second one is refused, and changes nothing."""

import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from support.job_scenes import bytes_of, write_small_scene
from test_foreign_files import SETTINGS, commands

import pagas_cl.__main__ as command_line
from pagas_cl.errors import OutputError
from pagas_cl.jobs.work_folder import one_run, work_folder

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("two") / "scene", 4)


@contextmanager
def another_run(folder):
    """Context: somebody else is at work in `folder`."""
    began, ended = threading.Event(), threading.Event()

    def hold():
        with one_run(folder):
            began.set()
            ended.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    assert began.wait(20)
    try:
        yield
    finally:
        ended.set()
        thread.join()


PLACES = {"depth": "", "report": "", "mesh": ".fine.ply.views", "kept": ".fine.ply.views", "both": ".fine.ply.views",
          "cameras": "", "tradeoff": "", "demo": ""}


@pytest.mark.parametrize("name", PLACES)
def test_the_second_run_is_refused_and_changes_nothing(scene, tmp_path, capsys, name):
    pytest.importorskip("open3d")
    from_depths = ("--depth-dir", str(scene / "depth_initial"))
    known = {**commands(scene, tmp_path, scene / "depth_initial"),
             "tradeoff": ("tradeoff", str(scene), *from_depths, "--report", str(tmp_path), "--quiet"),
             "demo": ("demo", "--output", str(tmp_path), "--quiet")}
    known["both"] = (*known["mesh"], "--save-depth", str(tmp_path / "maps"))
    command = [word for word in known[name] if word != "--json" and not word.endswith(".json")]
    with another_run(tmp_path / PLACES[name]):
        before = sorted(tmp_path.rglob("*"))
        assert command_line.run(command) == 1
        assert "another run is at work in" in capsys.readouterr().err and sorted(tmp_path.rglob("*")) == before
    assert not list(tmp_path.iterdir())


def test_two_runs_with_one_output(scene, tmp_path, capsys):
    """The second one is refused before it does anything; the first one ends as if nothing had been."""
    pytest.importorskip("open3d")
    command = ["refine", str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--output", str(tmp_path / "fine.ply"),
               *SETTINGS, "--set", "pyramid.steps=60"]
    first = subprocess.Popen([sys.executable, "-m", "pagas_cl", *command], stderr=subprocess.PIPE, text=True)
    folder = tmp_path / ".fine.ply.views"
    deadline = time.monotonic() + 60
    while not bytes_of(folder) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert command_line.run(command) == 1 and "another run is at work in" in capsys.readouterr().err
    assert first.wait(120) == 0, first.stderr.read()
    whole = (tmp_path / "fine.ply").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["fine.ply"]
    assert command_line.run(command) == 0 and (tmp_path / "fine.ply").read_bytes() == whole


def test_two_threads_with_one_folder(tmp_path):
    with one_run(tmp_path), one_run(tmp_path):      # the command, and what it calls
        calls = []

        def other():
            with pytest.raises(OutputError, match="another run"), one_run(tmp_path):
                pass
            calls.append(True)

        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert calls
    with one_run(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_what_a_killed_run_has_left_of_its_lock_goes_with_the_next(tmp_path):
    work_folder(tmp_path).mkdir()
    (work_folder(tmp_path) / "lock").touch()
    with one_run(tmp_path):
        pass
    assert not list(tmp_path.iterdir())
