"""Processes: a worker ends with the one that started it, one that was forked is refused, locks are nobody else's."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import pytest
from support.job_scenes import NOT_MEASURED, QUICK, bytes_of, load_small_scene, waits, write_small_scene

from pagas_cl.errors import DeviceError
from pagas_cl.jobs.pools import workers_of
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import refine_views
from pagas_cl.runtime import claim
from pagas_cl.system import child, locks

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="signals and forks of POSIX")]


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder for temporary files, with the locks of devices, apart from other programs on this machine."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("processes") / "scene", 4)


def until(holds, what):
    deadline = time.monotonic() + 60
    while not holds():
        if time.monotonic() > deadline:
            pytest.fail(f"{what}: not within a minute")
        time.sleep(0.02)


def children(process: int) -> set[int]:
    """Processes that `process` has started, as Linux lists them."""
    with open(f"/proc/{process}/task/{process}/children") as file:
        return set(map(int, file.read().split()))


def alive(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_ends_when_its_parent_does(scene, tmp_path, temporary, how):
    """And its device is free for the same command, which goes on."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pagas_cl", "refine", str(scene), "--depth-dir", str(scene / "depth_initial"),
               "--save-depth", str(out), "--devices", "all", "--quiet", "--set", "pyramid.steps=60", *NOT_MEASURED]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    until(lambda: bytes_of(out) or process.poll() is not None, "the first view")
    started = children(process.pid)
    process.send_signal(how)
    process.wait(60)
    until(lambda: not any(map(alive, started)), "the workers' end")
    assert started and subprocess.run(command, stderr=subprocess.DEVNULL, timeout=60).returncode == 0
    assert len(bytes_of(out)) == 4


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_never_hear_of_ctrl_c(temporary, device):
    """Which reaches them in a terminal: while they start, too, when they have not begun to ignore it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with workers_of(None, "all") as workers:
        for process in workers.executor._processes:
            blocked = re.search(r"SigBlk:\s*(\w+)", Path(f"/proc/{process}/status").read_text())[1]
            assert int(blocked, 16) >> signal.SIGINT - 1 & 1
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_a_second_ctrl_c_waits_for_no_worker(temporary, device):
    """A pool whose end is not waited for would wait for its processes for ever, and they for it."""
    def interrupt():
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), workers_of(None, "all") as workers:
        process, = workers.executor._processes
        sent = workers.submit(waits, 100)
        until(sent.running, "work")
        Thread(target=interrupt).start()
        workers.wait_for([sent])
    until(lambda: not alive(process), "the worker's end")


def test_a_run_that_ends_waits_for_no_device(temporary, device):
    """That another process is at work on: what was wrong with the input is said at once."""
    claim.claim_device()
    with workers_of(None, "all") as workers:
        process, = workers.executor._processes.values()
    until(lambda: process.exitcode is not None, "the worker's end")
    claim.give_back()
    assert process.exitcode == -signal.SIGKILL


HUNG = "import time; from pagas_cl.system.child import end_with_parent; end_with_parent(); print(1); time.sleep(600)"


@pytest.mark.skipif(sys.platform != "linux", reason="of Linux alone")
def test_a_child_that_hangs_ends_with_its_parent(tmp_path):
    (tmp_path / "hung.py").write_text(HUNG)
    source = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from pagas_cl.system import child; " \
           "child.ask('hung', {}, 600)"
    process = subprocess.Popen([sys.executable, "-c", source])
    until(lambda: children(process.pid), "the child")
    started = children(process.pid)
    time.sleep(1)     # until it has said that it ends with its parent
    process.kill()
    process.wait()
    until(lambda: not any(map(alive, started)), "the child's end")
    assert child.ask("json.tool", {}, 60).value is None


def test_a_forked_process_is_refused(scene, device):
    """In a child of its own and in a pool's; the parent goes on."""
    views, depths = load_small_scene(scene)
    process = os.fork()
    if not process:
        signal.alarm(20)
        try:
            refine_depth(views[0], views[1:], depths[0], config=QUICK, device=device)
        except DeviceError as error:
            os._exit(7 if "spawn" in str(error) else 8)
        os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 7
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        with pytest.raises(DeviceError, match="was forked from one that had used OpenCL"):
            refine_views(views, depths, config=QUICK, executor=pool)
    assert refine_views(views, depths, config=QUICK, names=["target"])[0].depth.any()


def test_locks_are_put_into_no_folder_of_others(tmp_path, temporary):
    """Another user may have made the folder, or a link in its place, or put links where the locks will be."""
    folder, victim = temporary / f"pagas_cl-{os.getuid()}", tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "other").mkdir()
    folder.symlink_to(tmp_path / "other")
    with pytest.raises(DeviceError, match="not yours alone"):
        claim._lock("a")
    folder.unlink()
    folder.mkdir(mode=0o700)
    folder.chmod(0o777)
    with pytest.raises(DeviceError, match="not yours alone"):
        claim._lock("a")
    folder.chmod(0o700)
    if os.getuid() == 0:
        os.chown(folder, 12345, 12345)
        with pytest.raises(DeviceError, match="not yours alone"):
            claim._lock("a")
        os.chown(folder, 0, 0)
    (folder / "a.lock").symlink_to(victim)
    with pytest.raises(DeviceError, match="cannot be opened"):
        claim._lock("a")
    (folder / "a.lock").unlink()
    (folder / "a.lock").write_text("kept")
    assert claim._lock("a") and claim._lock("a") and victim.read_text() == "precious"
    assert (folder / "a.lock").read_text() == "kept" and not list((tmp_path / "other").iterdir())
    claim.give_back()


def test_a_lock_that_was_removed_is_no_lock(tmp_path, monkeypatch):
    """Who held it may remove it between our opening and our locking: the next one would have a file of its own."""
    path, first = tmp_path / "lock", []
    whole = os.open

    def open_then_lose(*arguments):
        descriptor = whole(*arguments)
        if not first:
            first.append(path.unlink())
        return descriptor

    monkeypatch.setattr(os, "open", open_then_lose)
    descriptor = locks.take(path)
    assert os.path.samestat(os.stat(path), os.fstat(descriptor)) and locks.take(path) is None
    os.close(descriptor)


def test_windows_has_locks_of_its_own(tmp_path, monkeypatch):
    """msvcrt's in place of fcntl's, with the other error where one is held."""
    import fcntl

    def locking(descriptor, mode, length):
        try:
            fcntl.flock(descriptor, mode)
        except BlockingIOError as error:
            raise PermissionError(13, "Permission denied") from error

    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(
        locking=locking, LK_NBLCK=fcntl.LOCK_EX | fcntl.LOCK_NB))
    monkeypatch.setattr(sys, "platform", "win32")
    descriptor = locks.take(tmp_path / "lock")
    assert locks.take(tmp_path / "lock") is None
    os.close(descriptor)
    os.close(locks.take(tmp_path / "lock"))
