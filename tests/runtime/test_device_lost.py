"""A device that fails in the middle of a run: one sentence, finished views stay whole, the next run goes on from them.

The fault is injected where kernels are started: from one launch on, the driver answers with an error, as a lost device
does, once or for ever.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count as count_up
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from support.job_scenes import NOT_MEASURED, QUICK, bytes_of, load_small_scene, write_small_scene
from support.kill_trials import check_whole

from pagas_cl.errors import DeviceError, DeviceLostError, DeviceMemoryError, InputError, OutputError
from pagas_cl.jobs import run, worker
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.runtime import claim, program
from pagas_cl.runtime import device as devices
from pagas_cl.runtime.device import translate_cl_errors

pytestmark = pytest.mark.slow

CODES = {"OUT_OF_RESOURCES": -5, "DEVICE_NOT_AVAILABLE": -2, "INVALID_COMMAND_QUEUE": -36, "NVIDIA": -9999}


def driver_error(code: int, routine: str = "clEnqueueNDRangeKernel"):
    kind = cl.MemoryError if code == -4 else cl.RuntimeError
    return kind(cl._cl._ErrorRecord(routine, code, ""))


@pytest.fixture(scope="module")
def another():
    """Opens a device in a context other than the last one: one of two in turn, each with its queue, so that programs
    are built once and not anew for each of a hundred openings."""
    plain_open, first, turn = devices.opened, {}, count_up()

    def opened(info, cl_device, lanes):
        place = next(turn) % 2
        if place not in first:
            first[place] = plain_open(info, cl_device, lanes)
        return replace(first[place], is_lost=False)

    return opened


@pytest.fixture
def failing(monkeypatch, another):
    """A function: launches number `first` to `last` (counted from now) fail with `code`; `opens`: whether the device
    can be opened again."""
    plain = program.Launch.enqueue

    def install(first: int, last: float = float("inf"), code: int = -5, opens: bool = True):
        count = [0]

        def enqueue(launch, queue):
            count[0] += 1
            if first <= count[0] <= last:
                raise driver_error(code)
            return plain(launch, queue)

        def opened(*arguments):
            if not opens and count[0] >= first:
                raise driver_error(-2, "clCreateContext")
            return another(*arguments)

        monkeypatch.setattr(program.Launch, "enqueue", enqueue)
        monkeypatch.setattr(devices, "opened", opened)
        return count

    vars(devices._open_devices).clear()      # what other tests work on is not what fails
    yield install
    vars(devices._open_devices).clear()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Views, depth maps, and the bytes of an undisturbed run, with how many launches it took."""
    folder = tmp_path_factory.mktemp("lost")
    views, depths = load_small_scene(write_small_scene(folder / "scene", 5))
    plain, count = program.Launch.enqueue, [0]

    def enqueue(launch, queue):
        count[0] += 1
        return plain(launch, queue)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program.Launch, "enqueue", enqueue)
        refine_views(views, depths, config=QUICK, folder=folder / "whole")
    return SimpleNamespace(views=views, depths=depths, wanted=bytes_of(folder / "whole"), launches=count[0])


@pytest.mark.parametrize("opens", [False, True])
@pytest.mark.parametrize("share", [0.02, 0.55, 0.99])
def test_lost_for_good(scene, tmp_path, failing, device, opens, share):
    out = tmp_path / "out"
    failing(int(share * scene.launches), opens=opens)
    with pytest.raises(DeviceError, match="cannot be opened again" if not opens else "failed during") as caught:
        refine_views(scene.views, scene.depths, config=QUICK, folder=out)
    assert "start the same command again" in str(caught.value) and "\n" not in str(caught.value)
    finished = check_whole(out)
    assert finished == int(share * 5)
    assert all(scene.wanted[name] == data for name, data in bytes_of(out).items())
    assert not [path for path in out.rglob("*") if path.name.endswith(".part")]
    failing(10**9)
    refine_views(scene.views, scene.depths, config=QUICK, folder=out)
    assert bytes_of(out) == scene.wanted


@pytest.mark.parametrize("code", CODES.values(), ids=CODES)
def test_reset_once(scene, tmp_path, failing, device, code):
    """Opened anew, the run ends by itself with the same bytes."""
    first = int(0.5 * scene.launches)
    failing(first, first, code)
    refine_views(scene.views, scene.depths, config=QUICK, folder=tmp_path)
    assert bytes_of(tmp_path) == scene.wanted


def test_no_later_pass_works_on_a_context_that_failed(scene, tmp_path, failing, device, monkeypatch):
    """Smaller sizes that come first, their rounds, and full size have one store of photos, opened anew with it."""
    config, attempt, lost = QUICK.with_settings(effects__pyramid="on"), worker.Worker._attempt, []
    wanted = refine_views(scene.views, scene.depths, config=config)
    monkeypatch.setattr(worker.Worker, "_attempt", lambda one, *given: lost.append(one.device.is_lost)
                        or attempt(one, *given))
    failing(30, 30)
    found = refine_views(scene.views, scene.depths, config=config)
    assert len(lost) == 1 + 4 * 5 and not any(lost)
    assert all(np.array_equal(one.depth, other.depth) for one, other in zip(found, wanted))


def test_workers_that_all_lost_their_device_end_the_run(scene, tmp_path, monkeypatch, device):
    """Some views are done, then every worker says that it has no device: the run ends instead of asking for ever."""
    whole, calls = worker.Worker.records, [0]

    def records(*given):
        calls[0] += 1
        if calls[0] > 3:
            raise DeviceError("no device left")
        return whole(*given)

    monkeypatch.setattr(worker.Worker, "records", records)
    monkeypatch.setattr(run, "_STALLED", 0.0)
    monkeypatch.setattr(run, "_PAUSE", 0.0)
    with ThreadPoolExecutor(1) as pool, pytest.raises(DeviceError, match="no device left"):
        refine_views(scene.views, scene.depths, config=QUICK, folder=tmp_path, executor=pool)
    assert 0 < check_whole(tmp_path) < 5


@pytest.mark.parametrize("error, is_of_device", [
    (OSError("no such file"), False), (InputError("cut off"), False), (OutputError("disk full"), False),
    (DeviceMemoryError("too large"), True), (driver_error(-5), True)])
def test_only_what_the_device_did_has_a_worker_open_it_anew(device, error, is_of_device):
    def work(part, worker):
        raise error

    one = worker.Worker(replace(device))     # whose loss is nobody else's
    photos = one.photos
    with pytest.raises(DeviceError if is_of_device else type(error)):
        one.part(work, None)
    assert (one._photos is not photos) == is_of_device


def test_a_worker_waits_for_a_device_that_does_not_open(monkeypatch, device):
    def opened(*arguments):
        raise driver_error(-2, "clCreateContext")

    monkeypatch.setattr(devices, "opened", opened)
    monkeypatch.setattr(claim, "WAIT", 0.1)
    with pytest.raises(DeviceError, match="cannot be opened: .*DEVICE_NOT_AVAILABLE"):
        claim.claim_device(device.info.name)
    assert not claim._held, "others may try"


def test_one_view_says_it_in_one_sentence(scene, failing, device):
    failing(30)
    with pytest.raises(DeviceLostError, match=r"failed during the refinement of view '.*' \(clEnqueue.*OUT_OF_RES"):
        refine_depth(scene.views[0], scene.views[1:3], scene.depths[0], config=QUICK)
    failing(10**9)
    again = refine_depth(scene.views[0], scene.views[1:3], scene.depths[0], config=QUICK)
    assert again.counts["refined"] > 0, "a context of its own, not the one that failed"


def test_the_command_ends_with_status_1(scene, tmp_path, failing, device, capsys):
    import pagas_cl.__main__ as command_line

    folder = write_small_scene(tmp_path / "scene", 5)
    arguments = ["refine", str(folder), "--depth-dir", str(folder / "depth_initial"),
                 "--save-depth", str(tmp_path / "out"), "--quiet", "--set", "pyramid.steps=3", *NOT_MEASURED,
                 "agreement=off", "--context", "3"]
    failing(int(0.5 * scene.launches), opens=False)
    assert command_line.run(arguments) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pagas-cl:")]
    assert len(lines) == 1 and "finished views are kept" in lines[0]
    assert check_whole(tmp_path / "out") == 2


def test_other_commands_say_it_too(tmp_path, failing, device, capsys):
    import pagas_cl.__main__ as command_line

    folder = write_small_scene(tmp_path / "scene", 3)
    failing(5)
    assert command_line.run(["analyze", str(folder), "--depth-dir", str(folder / "depth_initial")]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pagas-cl:")]
    assert len(lines) == 1 and "failed" in lines[0] and "start the same command again" in lines[0]


def test_what_is_no_loss_stays_what_it_is(device):
    for code, kind in ((-4, DeviceMemoryError), (-6, DeviceMemoryError), (-52, cl.Error), (-30, cl.Error)):
        with pytest.raises(kind), translate_cl_errors(device, "a test"):
            raise driver_error(code)
    with pytest.raises(ZeroDivisionError), translate_cl_errors(device, "a test"):
        raise ZeroDivisionError
