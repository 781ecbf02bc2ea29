"""Compiled programs that are kept on disk: later processes read them, and nothing that a disk holds is believed."""

import hashlib
import shutil
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from pagas_cl.runtime import binaries, cache, program
from pagas_cl.runtime.binaries import compiled
from pagas_cl.runtime.memory import download, upload

pytestmark = pytest.mark.kernels
POCL = binaries.POCL
SOURCE = """
__kernel void add(__global int *values) { values[get_global_id(0)] += ADDED; }
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(binaries, "POCL", "no platform")      # of which programs are stored when they were built often
    return tmp_path / "programs"


def added(device, number=3) -> int:
    """What the kernel adds to 1."""
    values = upload(device, np.ones(4, np.int32))
    kernel = cl.Kernel(compiled(device, SOURCE, [*program.OPTIONS, f"-DADDED={number}"]), "add")
    kernel(device.queue, (4,), None, values)
    return int(download(device, values, 4, np.int32)[0]) - 1


@pytest.mark.parametrize("platform, written", [(POCL, [False, False, True]), ("another", [True])])
def test_what_takes_a_second_to_store_is_stored_when_it_has_been_built_often(device, folder, monkeypatch, platform,
                                                                            written):
    monkeypatch.setattr(binaries, "POCL", POCL)
    monkeypatch.setattr(binaries, "BUILDS", 3)
    there = replace(device, info=replace(device.info, platform=platform))
    for so in written:
        assert added(there) == 3 and bool(list(folder.glob("*.bin"))) is so
    assert bool(list(folder.glob("*.builds"))) is (platform == POCL)
    stored, = folder.glob("*.bin")
    assert added(there) == 3 and set(folder.glob("*.bin")) == {stored}
    whole = stored.read_bytes()
    stored.write_bytes(whole[:-1])
    for counted in folder.glob("*.builds"):
        counted.unlink()
    assert added(there) == 3 and len(stored.read_bytes()) >= len(whole), "what is damaged is written anew at once"


def test_pocl_is_called_what_it_calls_itself(device):
    assert (device.info.platform == POCL) is ("PoCL" in device.info.version)


def test_a_program_is_built_once_and_read_after_that(device, folder):
    assert added(device) == 3
    three, = folder.iterdir()
    assert added(device, 4) == 4
    four, = set(folder.iterdir()) - {three}
    shutil.copy(four, three)
    assert added(device) == 4, "what is on disk is taken, which is another program's here"


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:-1], lambda data: b"\0" * len(data),
                                    lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:]])
def test_a_damaged_file_is_written_anew(device, folder, damage):
    added(device)
    path, = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert added(device) == 3 and len(path.read_bytes()) >= len(whole)


def test_what_a_driver_refuses_is_built_from_its_source(device, folder):
    """A file of another driver under this one's name, whole as it is."""
    added(device)
    path, = folder.iterdir()
    path.write_bytes(hashlib.sha256(b"of another driver").digest() + b"of another driver")
    assert added(device) == 3


def test_a_disk_that_takes_nothing_costs_time_alone(device, folder, monkeypatch):
    def full(path, data):
        raise OSError("No space left on device")

    monkeypatch.setattr(cache, "write_whole", full)
    assert added(device) == added(device) == 3 and not folder.exists()


def test_a_source_that_does_not_compile_leaves_nothing(device, folder):
    with pytest.raises(cl.RuntimeError):
        compiled(device, SOURCE, [*program.OPTIONS])      # ADDED is not known
    assert not folder.exists()
