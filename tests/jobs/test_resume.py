"""Runs that are killed, interrupted or run out of disk lose nothing that was finished."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from support.job_scenes import NOT_MEASURED, QUICK, bytes_of, load_small_scene, said, slow_refine, write_small_scene
from support.kill_trials import WAYS, arguments, options, run_trials, undisturbed

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError, OutputError
from pagas_cl.jobs import refine_all
from pagas_cl.jobs.finished import FolderResults
from pagas_cl.refine import refine_views

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("resume") / "scene")


@pytest.fixture(scope="module")
def whole_run(scene, tmp_path_factory):
    """Folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    refine(scene, folder)
    return folder


@pytest.fixture(scope="module")
def wanted(whole_run):
    """Bytes of an undisturbed run."""
    return bytes_of(whole_run)


@pytest.fixture
def finished(whole_run, tmp_path):
    """A copy of that folder, to be damaged."""
    return Path(shutil.copytree(whole_run, tmp_path / "finished"))


def command(scene, out, *more):
    return ["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth", str(out), "--quiet",
            "--set", "pyramid.steps=3", *NOT_MEASURED, "agreement=off", "--context", "3", *map(str, more)]


def refine(scene, folder, **more):
    views, depths = load_small_scene(scene)
    return refine_views(views, depths, config=QUICK, folder=folder, **more)


def test_killed_at_random_times(tmp_path, monkeypatch):
    """A trial of each way to run; for many: `PYTHONPATH=tests:tests/jobs python -m support.kill_trials --trials
    50 --way all`."""
    if sys.platform != "linux":
        pytest.skip("reads in /proc what is left of a run")
    pytest.importorskip("distributed")
    monkeypatch.setenv("TMPDIR", str(tmp_path))      # locks of devices apart from those of other programs
    like = undisturbed(tmp_path, 4)
    with ExitStack() as stack:
        for way, trials in zip(WAYS, (1, 1, 1, 1)):
            figures = run_trials(trials, tmp_path / way, like, 1, options(way, tmp_path, stack))
            assert figures["kills"] == trials


def test_a_second_run_does_nothing_and_gives_the_same(scene, wanted, tmp_path):
    first = refine(scene, tmp_path)
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    again = refine(scene, tmp_path)
    assert not said(tmp_path, "began") and bytes_of(tmp_path) == wanted
    assert {path: path.stat().st_mtime_ns for path in stamps if "journal" not in str(path)} == \
        {path: stamp for path, stamp in stamps.items() if "journal" not in str(path)}
    assert all(np.array_equal(a.confidence, b.confidence) and a.counts == b.counts for a, b in zip(first, again))


def test_only_what_changed_is_done_again(scene, wanted, finished):
    refine(scene, finished)
    (finished / "context_02.npz").unlink()
    refine(scene, finished)
    assert said(finished, "began") == ["context_02.png"] and bytes_of(finished) == wanted


@pytest.mark.parametrize("file", ["target.npz", ".pagas_cl/views/target.npz", ".pagas_cl/views/target.json"])
def test_a_file_cut_short_is_made_again(scene, wanted, finished, file, caplog):
    path = finished / file
    path.write_bytes(path.read_bytes()[:-40])
    refine(scene, finished)
    assert said(finished, "began") == ["target.png"] and bytes_of(finished) == wanted
    assert "is refined again" in caplog.text


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"name": 3}', b"\xff\xfe"])
def test_a_damaged_record_is_not_believed(scene, wanted, finished, content):
    (finished / ".pagas_cl" / "views" / "target.json").write_bytes(content)
    refine(scene, finished)
    assert said(finished, "began") == ["target.png"] and bytes_of(finished) == wanted


def test_extras_that_are_missing_are_made(scene, tmp_path):
    alone = refine(scene, tmp_path, extras=False)
    assert not list((tmp_path / ".pagas_cl").rglob("*.npz"))
    with pytest.raises(InputError, match=r"view 'target.png' has no deviation: .*\(extras=False\)"):
        next(result for result in alone if result.name == "target.png").confidence
    results = refine(scene, tmp_path)
    assert all(result.confidence.shape == (48, 64) for result in results)


def test_interrupted_by_ctrl_c(scene, wanted, tmp_path):
    """In a process group of its own, as in a terminal; with a pool, so that its processes get the signal too."""
    out = tmp_path / "out"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    more = ["--set", "pyramid.steps=3", "--effect", "agreement=off", "--context", "3", "--devices", "all"]
    process = subprocess.Popen([*arguments(scene, out, ("--views", *SLOW)), *more], stderr=subprocess.PIPE, text=True,
                               start_new_session=True, env=environment)
    deadline = time.monotonic() + 60
    while not list(out.glob("*.npz")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    errors = process.communicate(timeout=60)[1]
    assert process.returncode in (0, 130) and "Traceback" not in errors
    if process.returncode == 130:
        assert "pagas-cl: interrupted" in errors
    assert bytes_of(out).items() <= wanted.items() and bytes_of(out)
    assert command_line.run(command(scene, out)) == 0
    assert bytes_of(out) == wanted


SLOW = ["target", *(f"context_{k:02d}" for k in range(7))]


def test_interrupted_here(scene, wanted, tmp_path):
    def progress(stage, done, total):
        if stage == "refine" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine(scene, tmp_path, progress=progress)
    assert len(bytes_of(tmp_path)) == 3
    refine(scene, tmp_path)
    assert len(said(tmp_path, "began")) == 5 and bytes_of(tmp_path) == wanted


def test_workers_are_stopped_before_any_has_written(tmp_path):
    results = FolderResults(tmp_path / "round_0")
    results.request_stop()
    assert results.is_stopping()


def test_interrupted_without_a_folder_nothing_is_left(scene, own_locks):
    """Workers end after their present view, and the folder that they shared goes then; claims of devices stay, where
    this process had none before."""
    def on_view(*_):
        raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        refine_all(slow_refine, *load_small_scene(scene), range(8), QUICK, executor=pool, on_view=on_view)
    assert {path.name for path in Path(tempfile.gettempdir()).iterdir()} <= {f"pagas_cl-{os.getuid()}"}


# -- disks ---------------------------------------------------------------------------------------------------------


def test_disk_full_while_writing(scene, wanted, tmp_path, monkeypatch):
    """The third depth map does not fit: the run ends with one sentence, two views stay, nothing is half there."""
    import pagas_cl.jobs.finished as finished

    whole, count = finished.write_arrays, []

    def full(file, arrays):
        count.append("depth" in arrays)
        if "depth" in arrays and sum(count) > 2:
            file.write(b"PK half an archive")
            raise OSError(28, "No space left on device")
        return whole(file, arrays)

    monkeypatch.setattr(finished, "write_arrays", full)
    with pytest.raises(OutputError, match=r"cannot write .*npz': No space left on device; finished views are kept"):
        refine(scene, tmp_path)
    assert len(bytes_of(tmp_path)) == 2 and not list(tmp_path.rglob("*.part"))
    monkeypatch.undo()
    refine(scene, tmp_path)
    assert len(said(tmp_path, "began")) == 6 and bytes_of(tmp_path) == wanted


def test_a_small_disk_that_is_full(scene, wanted, tmp_path, capsys):
    out = tmp_path / "small"
    out.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=56k", "tmpfs", str(out)]
    if sys.platform != "linux" or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a small disk is not permitted here; the same with an injected error is tested above")
    try:
        assert command_line.run(command(scene, out)) == 1
        errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pagas-cl: ")]
        assert len(errors) == 1 and "No space left on device" in errors[0]
        assert bytes_of(out).items() <= wanted.items() and not list(out.rglob("*.part"))
    finally:
        subprocess.run(["umount", str(out)], check=True)


def test_output_that_cannot_be_written(scene, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert command_line.run(command(scene, tmp_path / "file" / "out")) == 2
    assert "--save-depth: cannot write in the folder" in capsys.readouterr().err


def test_a_photo_deleted_during_the_run(tmp_path, capsys):
    """Views that need it are named; the others are done; put back, the same command does the rest."""
    scene, out = write_small_scene(tmp_path / "scene"), tmp_path / "out"
    views, depths = load_small_scene(scene)
    photo = scene / "images" / "context_06.png"
    content = photo.read_bytes()

    def progress(stage, done, total):
        if stage == "refine" and done == 0:
            photo.unlink(missing_ok=True)

    config = QUICK.with_settings(context__number=1)
    results = refine_views(views, depths, config=config, folder=out, progress=progress)
    failed = {view.name for view, result in zip(views, results) if "failed" in result.report}
    assert "context_06.png" in failed and len(failed) < len(views)
    assert all("context_06" in result.report["failed"] for result in results if "failed" in result.report)
    assert {f"{name[:-4]}.npz" for name in failed}.isdisjoint(bytes_of(out))
    photo.write_bytes(content)
    refine_views(views, depths, config=config, folder=out)
    refine_views(views, depths, config=config, folder=tmp_path / "undisturbed")
    assert bytes_of(out) == bytes_of(tmp_path / "undisturbed")


@pytest.mark.parametrize("what, more", [("method.surface.blocks.fuse_within", ["--fuse"]),
                                        ("refine.kept_mesh", [])])
def test_mesh_output_goes_on_too_and_leaves_nothing_next_to_it(scene, tmp_path, monkeypatch, what, more):
    pytest.importorskip("open3d")
    arguments = ["refine", str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--output", str(tmp_path / "fine.ply"),
                 "--quiet", "--set", "pyramid.steps=3", *NOT_MEASURED, *more]

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"pagas_cl.{what}", interrupted)
        assert command_line.run(arguments) == 130
    kept = tmp_path / ".fine.ply.views" / ".pagas_cl" / "views"
    records = [json.loads(path.read_text()) for path in kept.glob("*.json")]
    assert len(records) == 8 and not (tmp_path / "fine.ply").exists()
    monkeypatch.setattr("pagas_cl.jobs.worker.Worker._attempt", lambda *_: 1 / 0)  # nothing is left to refine
    assert command_line.run(arguments) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["fine.ply"]
