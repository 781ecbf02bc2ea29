"""Cameras refined through executors: the same bytes as in this process; workers that fail."""

import errno
import multiprocessing
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from support.camera_noise import noisy
from support.executors import SerialExecutor
from support.scenes import relief_scene

from pagas_cl.errors import DeviceError, InputError, PagasError
from pagas_cl.jobs.pools import Workers
from pagas_cl.jobs.run import results_of
from pagas_cl.refine import refine_cameras
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def two_share(own_locks, monkeypatch):
    """Two processes share a device."""
    monkeypatch.setenv("PAGAS_CL_SHARE", "2")


@pytest.fixture(scope="module")
def scene():
    made = relief_scene(97, 72, 6, held_out=0)
    cameras = noisy(made.cameras, 1.0, 0)
    return ([View(camera, view.image, view.mask, view.name) for camera, view in zip(cameras, made.all_views)],
            [made.initial_depth(camera) for camera in made.cameras])


@pytest.fixture(scope="module")
def alone(scene, device):
    return refine_cameras(*scene, device=device)


def plainly(found) -> dict:
    """What it says, without the time it took."""
    return {key: value for key, value in found.as_dict().items() if key != "seconds"}


def same(found, other) -> bool:
    return (all(np.array_equal(a.world_to_camera, b.world_to_camera) for a, b in zip(found.cameras, other.cameras))
            and np.array_equal(found.moved, other.moved) and plainly(found) == plainly(other))


def test_processes_give_the_bytes_of_this_one(scene, alone, tmp_path):
    assert alone.accepted
    reported = []
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        found = refine_cameras(*scene, executor=pool, folder=tmp_path / "run",
                               progress=lambda *given: reported.append(given))
        assert pool._processes and same(found, alone)
    assert not (tmp_path / "run").exists()
    assert reported[0] == ("refine the cameras", 0, 4) and reported[-1] == ("refine the cameras", 4, 4)


def test_a_pool_of_our_own_gives_them_too(scene, alone, tmp_path):
    (tmp_path / "run").mkdir()
    found = refine_cameras(*scene, device="all", folder=tmp_path / "run")
    assert same(found, alone) and not list((tmp_path / "run").iterdir())


class Refusing(SerialExecutor):
    """Gives up the device of every second task."""

    def __init__(self, error, every):
        self.error, self.every, self.submitted = error, every, 0

    def submit(self, work, /, *arguments, **keywords) -> Future:
        self.submitted += 1
        if self.submitted % self.every:
            return super().submit(work, *arguments, **keywords)
        future = Future()
        future.set_exception(self.error)
        return future


def test_workers_that_fail_are_done_without(scene, alone, caplog):
    often = Refusing(DeviceError("every device is at work"), 2)
    assert same(refine_cameras(*scene, executor=often), alone) and "given to workers again" in caplog.text
    never = Refusing(OSError("no such file"), 1)
    assert same(refine_cameras(*scene, executor=never), alone) and never.submitted < 50
    assert "in this process, since workers cannot: a worker failed: OSError('no such file')" in caplog.text


def test_where_workers_cannot_be_given_files_they_are_done_without(scene, alone, caplog, monkeypatch):
    def full(path, array):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    assert same(refine_cameras(*scene, executor=SerialExecutor()), alone)
    assert "in this process, since workers cannot: cannot write" in caplog.text and "No space left" in caplog.text


def test_parts_come_back_in_their_order():
    with ThreadPoolExecutor(2) as pool:
        assert results_of(Workers(pool, None), doubled, [3, 1, 2]) == [6, 2, 4]
        with pytest.raises(InputError, match="is no number"):
            results_of(Workers(pool, None), doubled, [3, None])
        with pytest.raises(PagasError, match="a worker failed: TypeError"):
            results_of(Workers(pool, None), doubled, [3, object()])


def doubled(part, context):
    if part is None:
        raise InputError("None is no number")
    return 2 * part
