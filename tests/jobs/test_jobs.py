"""Many views through executors: the same bytes, shared photos read once, failing views left out, devices not shared."""

import multiprocessing
import pickle
import subprocess
import sys
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from conftest import look_at
from support import job_scenes as work
from support.executors import SerialExecutor
from support.job_scenes import QUICK, bytes_of, load_small_scene, said, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMemoryError,
    InputError,
    KernelBuildError,
    OutputError,
    PagasError,
)
from pagas_cl.jobs import refine_all, run, task, worker
from pagas_cl.jobs.finished import FolderResults
from pagas_cl.jobs.keeping import Keeping
from pagas_cl.jobs.plan import Batch, Planner, along_curve, groups
from pagas_cl.jobs.pools import _open
from pagas_cl.jobs.run import HOPELESS
from pagas_cl.jobs.work_folder import kept_input
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.refine import refine_views
from pagas_cl.scene import npy_files
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.view import View

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_locks"),
              pytest.mark.filterwarnings("ignore:nothing was refined")]      # workers that only copy


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("jobs") / "scene")


@pytest.fixture(scope="module")
def alone(scene, tmp_path_factory):
    """Results of this process alone, and the bytes of its depth maps."""
    views, depths = load_small_scene(scene)
    folder = tmp_path_factory.mktemp("alone")
    refine_views(views, depths, config=QUICK, folder=folder)
    return refine_views(views, depths, config=QUICK), bytes_of(folder)


def same(results, others):
    return all(np.array_equal(a.depth, b.depth) and np.array_equal(a.deviation, b.deviation) and a.reason == b.reason
               and np.array_equal(a.confidence, b.confidence) for a, b in zip(results, others, strict=True))


# -- the same bytes, wherever ------------------------------------------------------------------------------------


def test_threads_and_files_give_the_bytes_of_the_loop(scene, alone, tmp_path):
    views, depths = load_small_scene(scene)
    files = [DepthSource(scene / "depth_initial" / f"{view.stem}.npz", (64, 48)) for view in views]
    with ThreadPoolExecutor(2) as pool:
        results = refine_views(views, files, config=QUICK, executor=pool, folder=tmp_path)
        assert same(results, alone[0]) and bytes_of(tmp_path) == alone[1]
    assert sorted(said(tmp_path, "ended")) == sorted(view.name for view in views)
    assert not (tmp_path / ".pagas_cl" / "inputs").exists() and len(bytes_of(tmp_path)) == len(views) == 8


def test_no_wait_for_workers_is_without_end(scene, tmp_path, monkeypatch):
    """Where Ctrl-C is heard of in between alone, as on Windows, the run ends."""
    whole, waits = run.wait, []
    monkeypatch.setattr(run, "wait", lambda futures, most, until: waits.append(most) or whole(futures, most, until))
    with ThreadPoolExecutor(1) as pool:
        refine_all(work.copy_depth, *load_small_scene(scene), range(8), QUICK, executor=pool, folder=tmp_path)
    assert waits and None not in waits and max(waits) <= 1


def test_processes_give_the_bytes_of_the_loop(scene, alone, monkeypatch):
    views, depths = load_small_scene(scene)
    in_memory = [View(view.camera, view.load_image(), None, view.name) for view in views]
    monkeypatch.setenv("PAGAS_CL_SHARE", "2")
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        results = refine_views(in_memory, depths, config=QUICK, executor=pool)
    assert same(results, alone[0])


def test_all_devices_of_this_machine(scene, alone, tmp_path):
    views, depths = load_small_scene(scene)
    seen = []
    results = refine_views(views, depths, config=QUICK, device="all", folder=tmp_path,
                           on_view=lambda view, initial, result: seen.append((view.name, initial.shape)))
    assert bytes_of(tmp_path) == alone[1] and same(results, alone[0])
    assert seen == [(view.name, (48, 64)) for view in views]  # in the order of the views
    assert {result.report["device"] for result in results} and all(r.report["worker"] for r in results)


def test_a_mesh_through_an_executor(scene):
    pytest.importorskip("open3d")
    from pagas_cl import refine_mesh

    views, _ = load_small_scene(scene)
    arguments = scene / "mesh_coarse.ply", [v.camera for v in views], [v.image for v in views]
    one = refine_mesh(*arguments, config=QUICK)
    with ThreadPoolExecutor(1) as pool:
        other = refine_mesh(*arguments, config=QUICK, executor=pool)
    assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)


def test_a_photo_is_read_once(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    import pagas_cl.scene.images as reading

    read, whole = [], reading.read_photo
    monkeypatch.setattr(reading, "read_photo", lambda path: (read.append(path), whole(path))[1])
    config = QUICK.with_settings(effects__cameras="off")        # which are measured before, from photos of their own
    refine_views(views, depths, config=config, folder=tmp_path)
    assert len(read) == len(set(read)) == len(views)


def test_views_that_see_no_surface_are_named(scene, caplog):
    views, depths = load_small_scene(scene)
    depths, names = [depths[0], 0 * depths[1], *depths[2:]], [view.name for view in views[:3]]
    found = refine_views(views, depths, config=QUICK, names=names)
    assert [result.name for result in found if result.depth.any()] == [views[0].name, views[2].name]
    assert "1 views see no surface" in caplog.text and f"left out: {views[1].name!r}" in caplog.text


# -- who fails ---------------------------------------------------------------------------------------------------


def test_a_view_whose_device_is_lost_is_tried_again(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    monkeypatch.setenv("PAGAS_CL_TEST_MARK", str(tmp_path / "mark"))
    results = refine_all(work.lost_once, views, depths, range(8), QUICK, folder=tmp_path / "out")
    assert (tmp_path / "mark").exists() and all("failed" not in r.report for r in results)
    assert len(said(tmp_path / "out", "failed")) == 1


@pytest.mark.parametrize("where", ["in memory", "in a folder", "in another process"])
def test_what_would_come_again_is_tried_once_and_logged_once(scene, tmp_path, caplog, where):
    """The same rules everywhere: the view is left out, and the others go on."""
    views, depths = load_small_scene(scene)
    place = {"in memory": {}, "in a folder": {"folder": tmp_path}, "in another process": {"device": "all"}}[where]
    results = refine_all(work.fails_always, views, depths, range(8), QUICK, **place)
    assert [k for k, r in enumerate(results) if "failed" in r.report] == [1] and not results[1].depth.any()
    assert caplog.text.count(f"view {views[1].name} has failed and is left out: LinAlgError: never") == 1
    if where == "in a folder":
        assert len(bytes_of(tmp_path)) == 7 and len(said(tmp_path, "began")) == 8


@pytest.mark.parametrize("kept", [False, True], ids=["in memory", "in a folder"])
def test_a_device_that_is_too_small_is_reported_once_before_work(scene, tmp_path, device, monkeypatch, caplog, kept):
    views, depths = load_small_scene(scene)
    monkeypatch.setattr(device.memory, "limit", 1000)
    with pytest.raises(DeviceMemoryError, match="a view of 64 x 48 needs .* it fits with photos of"):
        refine_all(refine_one, views, depths, range(8), QUICK, device=device, folder=tmp_path / "a" if kept else None)
    assert not caplog.records and not (tmp_path / "a").exists()


def test_a_result_that_cannot_be_kept_ends_the_run(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    monkeypatch.setattr("pagas_cl.jobs.finished.FolderResults.write", lambda *_: 1 / 0)
    with pytest.raises(PagasError, match="ZeroDivisionError"):
        refine_all(work.copy_depth, views, depths, range(8), QUICK, folder=tmp_path)


def test_a_killed_process_of_a_pool_is_replaced(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    monkeypatch.setenv("PAGAS_CL_TEST_MARK", str(tmp_path / "mark"))
    results = refine_all(work.killed_once, views, depths, range(8), QUICK, device="all", folder=tmp_path / "out")
    assert (tmp_path / "mark").exists() and all(r.depth.any() for r in results)
    assert len(said(tmp_path / "out", "ended")) == 8 and len(said(tmp_path / "out", "began")) == 9


def test_a_view_that_kills_its_process_is_left_out(scene, tmp_path):
    views, depths = load_small_scene(scene)
    results = refine_all(work.killed_always, views, depths, range(8), QUICK, device="all", folder=tmp_path)
    assert [k for k, r in enumerate(results) if "failed" in r.report] == [2]
    assert len(said(tmp_path, "ended")) == 7 and said(tmp_path, "began").count(views[2].name) == 3


def test_a_broken_executor_of_the_caller_is_reported(scene, tmp_path):
    views, depths = load_small_scene(scene)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        with pytest.raises(DeviceError, match="start the same command again"):
            refine_all(work.killed_always, views, depths, range(8), QUICK, executor=pool, folder=tmp_path)


@pytest.mark.parametrize("error, kind", [
    (InputError("no photo"), InputError), (DeviceMemoryError("too small"), DeviceMemoryError),
    (KernelBuildError("no kernel"), DeviceError), (DeviceLostError("gone"), DeviceLostError),
    (ZeroDivisionError("by 0"), PagasError)])
def test_what_every_view_fails_by_is_raised(scene, error, kind):
    """One table has it, whoever works: an error of the same kind, in one sentence."""
    def fails(*_):
        raise error

    with pytest.raises(kind, match=str(error)) as caught:
        refine_all(fails, *load_small_scene(scene), range(3), QUICK)
    assert type(caught.value) is kind


class Lost(SerialExecutor):
    """Loses every worker that a task is given to."""

    def submit(self, task, /, *arguments, **keywords):
        lost = Future()
        lost.set_exception(OSError("the worker has gone"))
        return lost


@pytest.mark.parametrize("number", [2, HOPELESS])
def test_workers_that_are_all_lost_are_a_device_that_is_lost(scene, tmp_path, number):
    which = "the first 8 views have all" if number == HOPELESS else "every view has"
    with pytest.raises(DeviceLostError, match=f"{which} failed.*: OSError: the worker has gone"):
        refine_all(work.copy_depth, *load_small_scene(scene), range(number), QUICK, executor=Lost(), folder=tmp_path)


class Pure(SerialExecutor):
    """Keeps what equal arguments gave, as Dask's executor does unless it is set that functions are not pure."""

    def __init__(self):
        self.kept, self.sent = {}, 0

    def submit(self, task, /, *arguments, **keywords):
        self.sent += 1
        key = pickle.dumps(arguments)
        if key not in self.kept:
            self.kept[key] = super().submit(task, *arguments, **keywords)
        return self.kept[key]


@pytest.mark.parametrize("refusals", [3, 1000])
def test_a_worker_without_a_device_is_tried_again_but_not_for_ever(scene, tmp_path, monkeypatch, caplog, refusals):
    views, depths = load_small_scene(scene)
    claim, times = worker.claim_device, []

    def refuse(names):
        times.append(names)
        if len(times) <= refusals:
            raise DeviceError("every device is at work for another process")
        return claim(names)

    monkeypatch.setattr(worker, "claim_device", refuse)
    monkeypatch.setattr(run, "_PAUSE", 0.0)
    executor, few = Pure(), refusals < HOPELESS
    with nullcontext() if few else pytest.raises(DeviceError, match="at work for another process"):
        results = refine_all(work.copy_depth, views, depths, range(8), QUICK, executor=executor, folder=tmp_path)
        assert all(r.depth.any() for r in results)
    assert executor.sent <= 8 + HOPELESS and caplog.text.count("a worker cannot work") == 1


class ToTheIdle(SerialExecutor):
    """As Dask does, gives tasks to the worker that is idle, which has no device, unless that waits for one."""

    sent, waits = 0, False

    def submit(self, task, work, *arguments):
        self.sent += 1
        if self.sent == 1 or self.waits:
            self.waits = False
            return super().submit(task, work, *arguments)
        self.waits = work is _open
        future = Future()
        if not self.waits:
            future.set_exception(DeviceError("every device is at work for another process"))
        return future


def test_a_batch_that_a_worker_without_a_device_has_refused_gets_to_another(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    monkeypatch.setattr(run, "_PAUSE", 0.0)
    monkeypatch.setattr(run, "_STALLED", 0.0)
    results = refine_all(work.copy_depth, views, depths, range(8), QUICK, executor=ToTheIdle(), folder=tmp_path)
    assert all(r.depth.any() for r in results)


class Other(SerialExecutor):
    """Its workers run another version than the one that sends the tasks."""

    def submit(self, task, /, *arguments, **keywords):
        *given, version, attempt = arguments
        return super().submit(task, *given, f"not {version}", attempt)


def test_another_version_of_the_code_is_refused(scene, tmp_path):
    views, depths = load_small_scene(scene)
    with pytest.raises(DeviceError, match="another version"):
        refine_all(work.copy_depth, views, depths, range(8), QUICK, executor=Other(), folder=tmp_path)


def test_the_exit_status_says_of_views_left_out(scene, tmp_path, monkeypatch, capsys):
    import pagas_cl.refine as refining

    monkeypatch.setattr(refining, "refine_one", work.fails_always)
    status = command_line.run(["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth",
                               str(tmp_path / "out"), "--quiet", *work.NOT_MEASURED])
    assert status == 1 and "1 of 8 views failed and were left out: " in capsys.readouterr().err
    assert len(bytes_of(tmp_path / "out")) == 7


# -- what makes two tasks the same -------------------------------------------------------------------------------


def test_keys_follow_every_input(scene, monkeypatch):
    views, depths = load_small_scene(scene)

    def keys(views=views, depths=depths, config=QUICK):
        on_disk, kept = Keeping(scene.parent / "store", 1).inputs(views, depths)
        planner = Planner(on_disk, kept, depths, config, refine_one)
        return [planner.task(k).key for k in range(8)]

    first = keys()
    assert first == keys() and len(set(first)) == 8
    assert keys(config=QUICK.with_settings(fusion__voxel=2.0)) == first
    assert all(a != b for a, b in zip(first, keys(config=QUICK.with_settings(solver__rate=0.05))))
    moved = views[0].camera.world_to_camera.copy()
    moved[0, 3] += 1e-12
    other = View(replace(views[0].camera, world_to_camera=moved), views[0].image, None, views[0].name)
    assert keys(views=[other, *views[1:]])[0] != first[0]
    photo = views[0].load_image().copy()
    photo[0, 0, 0] ^= 1
    assert keys(views=[View(views[0].camera, photo, None, views[0].name), *views[1:]])[0] != first[0]
    deeper = depths[3].copy()
    deeper[20, 20] = np.nextafter(deeper[20, 20], np.float32(np.inf))
    later = keys(depths=[*depths[:3], deeper, *depths[4:]])
    assert [a == b for a, b in zip(first, later)] == [k != 3 for k in range(8)]
    monkeypatch.setattr(task, "RESULTS_FORMAT", task.RESULTS_FORMAT + 1)
    assert not set(first) & set(keys())


def test_many_threads_read_arrays(tmp_path):
    """CPython 3.11 fails now and then where two threads parse the header of a .npy file."""
    arrays = [np.full((3, k + 1), k, np.float32) for k in range(8)]
    for k, array in enumerate(arrays):
        np.save(tmp_path / f"{k}.npy", array)
        np.savez_compressed(tmp_path / f"{k}.npz", depth=array)
    with ThreadPoolExecutor(8) as readers:
        for read, suffix in ((npy_files.read_npy, "npy"), (npy_files.read_first, "npz")):
            paths = [tmp_path / f"{k}.{suffix}" for k in range(8)] * 50
            assert all(np.array_equal(got, arrays[k % 8]) for k, got in enumerate(readers.map(read, paths)))


def test_a_damaged_array_is_found(tmp_path):
    array = np.arange(5000, dtype=np.float32)
    stored = kept_input(tmp_path, array)
    assert np.array_equal(stored.load(), array)
    stored.file.write_bytes(stored.file.read_bytes()[:-1] + b"\1")
    with pytest.raises(InputError, match="is damaged"):
        stored.load()
    stored.file.write_bytes(stored.file.read_bytes()[:100])
    with pytest.raises(InputError, match="cannot be read"):
        stored.load()
    assert np.array_equal(kept_input(tmp_path, array).load(), array)  # written anew


def test_names_that_lead_outside_are_refused(scene, tmp_path):
    views, depths = load_small_scene(scene)
    views = [View(v.camera, v.image, None, "../" + v.name) for v in views]
    with pytest.raises(InputError, match="cannot name files"):
        refine_all(work.copy_depth, views, depths, range(8), QUICK, folder=tmp_path / "a")


def test_a_folder_that_cannot_be_made(scene, tmp_path):
    views, depths = load_small_scene(scene)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write .* start the same command again"):
        refine_all(work.copy_depth, views, depths, range(8), QUICK, folder=tmp_path / "file" / "out")


# -- who goes where ----------------------------------------------------------------------------------------------


def ring(number):
    angles = np.linspace(0, 2 * np.pi, number, endpoint=False)
    return [look_at((4 * np.sin(a), 0.5, -4 * np.cos(a)), (0, 0, 0), name=f"{k:05d}.png")
            for k, a in enumerate(angles)]


def test_neighbours_follow_one_another():
    centers = np.array([camera.center for camera in ring(256)])
    shuffled = np.random.default_rng(0).permutation(256)
    order = along_curve(centers[shuffled])
    assert sorted(order) == list(range(256))
    step = np.linalg.norm(np.diff(centers[shuffled][order], axis=0), axis=1)
    assert np.median(step) < 2 * np.pi * 4 / 256 * 1.01 and step.sum() < 6 * 2 * np.pi * 4


def test_groups_hold_every_view_once_and_workers_have_stretches_of_their_own():
    cameras = ring(400)
    views = [View(camera, "none.png", None, camera.name) for camera in cameras]
    chooser = PartnerChooser(cameras, [np.full((120, 160), 4, np.float32)] * 400, QUICK.context)
    parts = groups(list(range(400)), views, 4)
    assert sorted(k for part in parts for k in part) == list(range(400)) and 4 * 8 <= len(parts) <= 4 * 10
    photos = [{i for part in parts[k::4] for target in part for i in chooser.choose(target).all} for k in range(4)]
    assert max(map(len, photos)) < 140  # given out in turn: 100 of its own, and some at the ends
    assert groups([7], views, 64) == [[7]]


def test_a_batch_has_the_views_that_its_tasks_need(scene, tmp_path):
    views, depths = load_small_scene(scene)
    planner = Planner(views, [kept_input(tmp_path, depth) for depth in depths], depths, QUICK, refine_one)
    template = Batch(refine_one, {}, {}, (), QUICK, FolderResults(tmp_path))
    batch = planner.batch([planner.task(0)], template)
    assert batch.views.keys() == batch.digests.keys() == set(batch.tasks[0].partners.all)


CLAIM = """
import sys
from pagas_cl.runtime.claim import claim_device
from pagas_cl.errors import DeviceError
from pagas_cl.runtime import claim
claim.WAIT = 0.0
try:
    claim_device("all")
except DeviceError as error:
    print(error)
else:
    print("mine", flush=True)
    sys.stdin.read()
"""


def test_two_processes_take_different_devices(monkeypatch):
    monkeypatch.delenv("PAGAS_CL_SHARE", raising=False)

    def start():
        return subprocess.Popen([sys.executable, "-c", CLAIM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    first = start()
    assert first.stdout.readline() == "mine\n"
    second = start()
    said_by = second.communicate()[0]
    assert "at work for another process" in said_by and "PAGAS_CL_SHARE=2" in said_by
    monkeypatch.setenv("PAGAS_CL_SHARE", "2")
    assert start().communicate()[0] == "mine\n"
    first.kill()
    first.wait()
    monkeypatch.delenv("PAGAS_CL_SHARE")
    assert start().communicate()[0] == "mine\n"  # a lost worker's place is free again
