"""A real Dask cluster: a scheduler and up to three workers, each a process with an address of its own (loopback)."""

import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from support import job_scenes as work
from support.camera_noise import noisy
from support.job_scenes import QUICK, TESTS, bytes_of, compile_once, load_small_scene, said, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import DeviceError
from pagas_cl.jobs import refine_all
from pagas_cl.jobs.pools import dask_executor
from pagas_cl.method.view.one_view import refine_one
from pagas_cl.progress import progress_of
from pagas_cl.refine import refine_cameras, refine_views

pytestmark = pytest.mark.slow

distributed = pytest.importorskip("distributed")

VIEWS = 10


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = write_small_scene(tmp_path_factory.mktemp("cluster") / "scene", VIEWS)
    compile_once(folder)
    return folder


class Cluster:
    """Scheduler and workers as a person would start them: `dask scheduler`, `dask worker --nthreads 1`."""

    def __init__(self, folder, stack: ExitStack):
        self.folder, self.stack, self.workers = folder, stack, {}
        paths = os.pathsep.join([str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
        self.environment = {**os.environ, "PYTHONPATH": paths, "PAGAS_CL_SHARE": "4", "TMPDIR": str(folder),
                            "DASK_DISTRIBUTED__WORKER__DAEMON": "False"}
        self.file = folder / "scheduler.json"
        self.scheduler = self._start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                                     "--no-dashboard", "--scheduler-file", str(self.file))
        self._until(self.file.is_file, "the scheduler")
        self.client = stack.enter_context(distributed.Client(scheduler_file=str(self.file), set_as_default=False))
        self.address = self.client.scheduler.address

    def add(self, host: str) -> None:
        """Start one worker at the address `host`, where there is none."""
        if host in self.workers:
            return
        self.workers[host] = self._start("distributed.cli.dask_worker", self.address, "--host", host, "--nthreads", "1",
                                         "--no-nanny", "--no-dashboard", "--local-directory", str(self.folder / host))

    def ready(self, number: int) -> None:
        self._until(lambda: len(self.client.scheduler_info()["workers"]) >= number, f"{number} workers")

    def kill(self, host: str) -> None:
        self.workers[host].send_signal(signal.SIGKILL)

    def _start(self, module: str, *arguments):
        process = subprocess.Popen([sys.executable, "-m", module, *arguments], env=self.environment, cwd=self.folder,
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.stack.callback(process.wait)
        self.stack.callback(process.kill)
        return process

    @staticmethod
    def _until(holds, what: str) -> None:
        deadline = time.monotonic() + 60
        while not holds():
            if time.monotonic() > deadline:
                pytest.fail(f"{what} did not come up within a minute")
            time.sleep(0.1)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """One for all tests, since it takes longer to start than they do; the first one leaves it without a worker."""
    with ExitStack() as stack:
        yield Cluster(tmp_path_factory.mktemp("cluster"), stack)


def test_a_worker_is_killed_and_another_joins(scene, cluster, tmp_path):
    views, depths = load_small_scene(scene)
    alone = tmp_path / "alone"
    refine_all(refine_one, views, depths, range(VIEWS), QUICK, folder=alone)
    for host in ("127.0.0.2", "127.0.0.3"):
        cluster.add(host)
    cluster.ready(2)
    happened = []

    def progress(stage, done, total):
        if stage == "refine" and done >= 3 and not happened:
            happened.append(done)
            cluster.kill("127.0.0.3")
            cluster.add("127.0.0.5")

    out = tmp_path / "out"
    refine_all(work.slow_refine, views, depths, range(VIEWS), QUICK, folder=out, progress=progress_of(progress),
               executor=cluster.client.get_executor(pure=False), extras=False)
    assert happened and bytes_of(out) == bytes_of(alone) and len(bytes_of(out)) == VIEWS
    began, ended = said(out, "began"), said(out, "ended")
    missed = {view.name for view in views} - set(ended)
    assert set(began) == missed | set(ended) and len(ended) == len(set(ended))     # no finished view is done again
    assert len(missed) <= 1                                      # the worker was killed once its files were there
    assert len(began) - len(set(began)) <= 1                     # the killed worker's view is begun twice
    assert len(list((out / ".pagas_cl" / "journal").iterdir())) >= 3
    assert cluster.workers["127.0.0.3"].wait(10) == -signal.SIGKILL


def test_a_cluster_without_workers_is_waited_for_aloud(tmp_path, caplog):
    with ExitStack() as stack, caplog.at_level(logging.WARNING, "pagas_cl"):
        dask_executor(Cluster(tmp_path, stack).address).shutdown()
    assert "no worker is connected to the Dask scheduler at tcp://" in caplog.text


def test_a_scheduler_that_ends_ends_the_run(scene, tmp_path, monkeypatch):
    views, depths = load_small_scene(scene)
    monkeypatch.setattr("pagas_cl.jobs.pools.PATIENCE", 5)
    with ExitStack() as stack:
        cluster = Cluster(tmp_path, stack)
        cluster.add("127.0.0.6")
        cluster.ready(1)

        def progress(stage, done, total):
            if stage == "refine" and done == 1:
                cluster.scheduler.kill()

        with pytest.raises(DeviceError, match="tasks .the Dask scheduler has ended .*.; finished views are kept"):
            refine_all(work.slow_refine, views, depths, range(VIEWS), QUICK, folder=tmp_path / "out",
                       progress=progress_of(progress), executor=cluster.address)
    assert any((tmp_path / "out").glob("*.npz"))


def test_from_the_command_line(scene, cluster, tmp_path, monkeypatch, capsys):
    cluster.add("127.0.0.2")
    cluster.ready(1)
    monkeypatch.chdir(scene.parent)     # where the workers are not
    command = ["refine", scene.name, "--depth-dir", f"{scene.name}/depth_initial", "--quiet", "--set",
               "pyramid.steps=3", *work.NOT_MEASURED, "--views", "target", "context_00", "context_01"]
    assert command_line.run([*command, "--save-depth", str(tmp_path / "a"), "--scheduler", cluster.address]) == 0
    assert command_line.run([*command, "--save-depth", str(tmp_path / "b")]) == 0
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b") and len(bytes_of(tmp_path / "a")) == 3
    refused = [*command, "--save-depth", str(tmp_path / "c"), "--scheduler", "tcp://127.0.0.1:9"]
    import pagas_cl.jobs.pools as workers

    workers.PATIENCE = 2
    assert command_line.run(refused) == 1 and "no Dask scheduler answers" in capsys.readouterr().err


def test_temporary_results_come_back_whole(scene, cluster):
    views, depths = load_small_scene(scene)
    cluster.add("127.0.0.2")
    cluster.ready(1)
    executor = cluster.client.get_executor(pure=False)
    results = refine_views(views, depths, names=["target"], config=QUICK, executor=executor)
    assert results[0].confidence.shape == (48, 64) and results[0].report["worker"]


def test_blocks_of_cameras_are_added_up_by_its_workers(scene, cluster, monkeypatch):
    views, depths = (part[:7] for part in load_small_scene(scene))
    cameras = noisy([view.camera for view in views], 1.0, 0)
    views = [replace(view, camera=camera) for view, camera in zip(views, cameras)]
    alone = refine_cameras(views, depths)
    cluster.add("127.0.0.2")
    cluster.ready(1)
    monkeypatch.setattr("pagas_cl.jobs.place.blocks", None)      # not in this process
    found = refine_cameras(views, depths, executor=cluster.address)
    assert found.moved.max() > 0.1 and np.array_equal(found.moved, alone.moved) and found.pairs == alone.pairs
