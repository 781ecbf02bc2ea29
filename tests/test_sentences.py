"""What goes wrong around the work ends in one sentence, and what need not stop it does not."""

import errno
import json
import os
import struct
import subprocess
import sys
import zlib
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from support.job_scenes import QUICK, load_small_scene, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.app.commands import _process
from pagas_cl.app.report import Report
from pagas_cl.app.tradeoffs.study import Book
from pagas_cl.errors import InputError, OutputError
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.result import DepthResult
from pagas_cl.runtime import allocations, cache, device
from pagas_cl.scene import images
from pagas_cl.system import files

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("sentences") / "scene", 4)


# -- streams ---------------------------------------------------------------------------------------------------------

STREAMS = {"2>&-": 0, ">&-": 0, "<&- >&- 2>&-": 0, "| head -1": 0, "2>&1 >/dev/null | head -1": 0, "2>/dev/full": 0,
           ">/dev/full": 1}


@slow
@pytest.mark.skipif(sys.platform != "linux", reason="a shell and /dev/full")
@pytest.mark.parametrize("streams", STREAMS)
def test_streams_that_nobody_reads(scene, tmp_path, streams):
    """The work is done all the same; where what is printed is the result, the status says that it is lost."""
    command = f"'{sys.executable}' -m pagas_cl evaluate '{scene}/depth_initial' '{scene}/depth_true' " \
              f"--scene '{scene}' --json '{tmp_path}/figures.json' --debug"
    ended = subprocess.run(["bash", "-c", f"set -o pipefail; {command} {streams}"], capture_output=True, text=True)
    assert ended.returncode == STREAMS[streams], ended.stderr
    assert "Traceback" not in ended.stderr and "Exception ignored" not in ended.stderr
    assert json.loads((tmp_path / "figures.json").read_text())


@slow
def test_a_run_whose_messages_nobody_reads(scene, tmp_path):
    command = f"'{sys.executable}' -m pagas_cl refine '{scene}' --depth-dir '{scene}/depth_initial' --save-depth " \
              f"'{tmp_path}' --set pyramid.steps=3 --no-align --effect cameras=off --views target"
    for streams in ("2>&1 | head -1", ">&- 2>&-"):
        assert subprocess.run(["bash", "-c", f"set -o pipefail; {command} {streams}"]).returncode == 0
        assert (tmp_path / "target.npz").exists()
        (tmp_path / "target.npz").unlink()


@pytest.mark.parametrize("number, fault", [(errno.EINVAL, ""), (errno.EPIPE, ""), (errno.ENOSPC, "No room")])
def test_what_is_no_fault_of_a_stream(tmp_path, number, fault):
    """That nobody reads any more is EINVAL on Windows."""
    with open(tmp_path / "out", "w") as file:
        stream = _process._Lenient(Mock(write=Mock(side_effect=OSError(number, "No room")), fileno=file.fileno))
        stream.write("a")
    assert stream.fault == fault


# -- disks -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def full(monkeypatch):
    """No file can be brought to the disk."""
    def refuse(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", refuse)


def test_a_full_disk_under_pictures(scene, tmp_path, full):
    views, depths = load_small_scene(scene)
    with pytest.raises(OutputError, match="cannot write .*target_photo.jpg': No space left on device; make room"):
        Report(tmp_path).add(views[0], depths[0], DepthResult.unrefined(views[0].camera, depths[0], "a test"))
    assert not list(tmp_path.iterdir())


@slow
def test_a_full_disk_under_the_demo(tmp_path, capsys, full):
    assert command_line.run(["demo", "--output", str(tmp_path / "demo"), "--width", "64", "--context", "2"]) == 1
    text = capsys.readouterr().err.splitlines()[-1]
    assert text.startswith("pagas-cl: cannot write ") and "No space left on device" in text


def test_any_other_error_of_a_disk(capsys):
    status = command_line._explain(PermissionError(13, "Permission denied", "/some/file"))
    assert status == 1 and "'/some/file' cannot be written or read: Permission denied" in capsys.readouterr().err


def test_a_cache_that_cannot_be_written(tmp_path, monkeypatch, caplog):
    """PoCL has no device then: it gets another folder, and the user hears of the folder and not of drivers."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    _process.replace_cache()
    assert "cannot be written" in caplog.text and "XDG_CACHE_HOME" in caplog.text
    given = os.environ["XDG_CACHE_HOME"]
    assert given.startswith(str(tmp_path)) and str(cache.folder()).startswith(given)
    _process.replace_cache()      # now it can
    assert os.environ["XDG_CACHE_HOME"] == given
    _process._remove(given, os.getpid() + 1)
    assert os.path.isdir(given)
    _process._remove(given, os.getpid())
    assert not os.path.isdir(given)


# -- inputs ----------------------------------------------------------------------------------------------------------

STRANGE = {"object": lambda depth: depth.astype(object), "text": lambda depth: depth.astype(str),
           "ragged": lambda depth: [[1, 2], [3]], "complex": lambda depth: depth.astype(complex),
           "a mask": lambda depth: depth > 0}


@slow
@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize("folder", [None, "out"])
def test_depths_that_are_no_numbers(scene, tmp_path, kind, folder):
    views, depths = load_small_scene(scene)
    strange = [STRANGE[kind](depth) for depth in depths]
    with pytest.raises(InputError, match="depth map of view 'target.png'"):
        refine_views(views, strange, config=QUICK, folder=folder and tmp_path / folder)
    with pytest.raises(InputError, match="depth map of view 'target.png'"):
        refine_depth(views[0], views[1:], strange[0], config=QUICK)


@slow
def test_depths_as_lists_are_depths(scene, tmp_path):
    views, depths = load_small_scene(scene)
    lists = [depth.astype(np.float64).tolist() for depth in depths]
    one, = refine_views(views, lists, names=["target"], config=QUICK)
    other, = refine_views(views, lists, names=["target"], config=QUICK, folder=tmp_path)
    assert np.array_equal(one.depth, other.depth) and one.counts["refined"]


def test_a_large_photo_is_no_attack(tmp_path, monkeypatch):
    """Beyond Pillow's limit a photo is read; beyond pagas_cl's it is refused by what it is, and not as cut off."""
    pixels = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert np.array_equal(images.read_photo(tmp_path / "a.png"), pixels) and Image.MAX_IMAGE_PIXELS == 1000
    monkeypatch.setattr(images, "MOST_PIXELS", 4000)
    with pytest.raises(InputError, match="has 80 x 60 pixels, expected at most 0 million"):
        images.read_photo(tmp_path / "a.png")
    monkeypatch.undo()

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 40000, 30000, 8, 2, 0, 0, 0))
    (tmp_path / "b.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with pytest.raises(InputError, match="has 40000 x 30000 pixels, expected at most 500 million"):
        images.image_size(tmp_path / "b.png")


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"device": "a"}', '{"device": "a", "records": 3}',
                                  '{"device": "a", "records": [3]}', '{"device": "a", "records": [{"key": "a"}]}',
                                  '{"device": "a", "records": [{"key": "a", "case": 1, "setting": "a"}]}',
                                  '{"device": "a", "records": [{"key": "a", "case": "a", "setting": "a"}]}'])
def test_a_damaged_record_of_a_study(tmp_path, text):
    (tmp_path / "tradeoff.json").write_text(text)
    with pytest.raises(InputError, match="is no record of a study"):
        Book(tmp_path, "a", [])


@slow
@pytest.mark.parametrize("place", [(), ("--devices", "all")])
def test_a_bad_limit_of_memory_is_reported_once_before_the_work(scene, tmp_path, monkeypatch, capsys, place):
    monkeypatch.setenv(allocations.ENVIRONMENT, "much")
    monkeypatch.setattr(device, "_still_open", lambda *_: None)      # as in a process of its own
    assert command_line.run(["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth",
                             str(tmp_path / "out"), "--no-align", *place]) == 2
    text = capsys.readouterr().err
    assert text.count("PAGAS_CL_MEMORY is 'much', expected megabytes above 0") == 1 and "tried again" not in text
