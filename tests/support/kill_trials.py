"""Kill `pagas-cl refine` at random times, start it again with the same command, compare with an undisturbed run.

    PYTHONPATH=tests:tests/jobs python -m support.kill_trials --trials 50 --way all

One trial is one SIGKILL or SIGTERM: mostly once k of the depth maps of all rounds are written, k drawn among those that
are not yet there, else after a time that is drawn. A run is killed again and again until it finishes by itself; then
the next one begins. Ways: in this process, one process a device (--devices), a pool of the caller's, a Dask cluster
(one worker, which outlives the runs). After each trial no process that the killed one had started may be left, the
folder's lock is free, and files of others beside and below it are as they were.
"""

import argparse
import math
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from support.here import command
from support.job_scenes import NOT_MEASURED, QUICK, bytes_of, load_small_scene, write_small_scene

from pagas_cl.jobs import follow_parent
from pagas_cl.method.view.rounds import later_rounds
from pagas_cl.refine import refine_views
from pagas_cl.system import locks

CONFIG = QUICK.with_settings(pyramid__steps=(12,), effects__agreement="auto")      # as the command line has it
WAYS = ("in-process", "devices", "executor", "dask")
STRANGERS = ("notes.txt", ".target.npz.other-7.part", "inputs/a.npy", "left/target.npz", "stop", "../lock", "../a.part")


def refine(scene: Path, out: Path, more=()) -> list[str]:
    return ["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth", str(out), "--quiet",
            "--set", "pyramid.steps=12", "--context", "3", *NOT_MEASURED, *more]


def arguments(scene: Path, out: Path, more=()) -> list[str]:
    """Of a process of its own."""
    if tuple(more) == ("executor",):
        return [sys.executable, "-m", "support.kill_trials", "--through-executor", str(scene), str(out)]
    return [sys.executable, "-m", "pagas_cl", *refine(scene, out, more)]


def through_executor(scene: Path, out: Path) -> None:
    """What somebody's own program does."""
    views, depths = load_small_scene(scene)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=follow_parent) as pool:
        refine_views(views, depths, config=CONFIG, folder=out, executor=pool)


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}


def run_whole(scene: Path, out: Path, more=()) -> None:
    """Run undisturbed, in this process: only what is killed needs one of its own."""
    if tuple(more) == ("executor",):
        through_executor(scene, out)
        return
    done = command(*refine(scene, out, more))
    if done.returncode != 0:
        raise RuntimeError(done.stderr)


def family(process: int) -> set[int]:
    """Processes that `process` has started, and those that they have, as Linux tells."""
    try:
        tasks = [path / "children" for path in Path(f"/proc/{process}/task").iterdir()]
        found = {int(number) for task in tasks for number in task.read_text().split()}
    except OSError:
        return set()
    return found.union(*map(family, found)) if found else found


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def written(out: Path) -> list[int]:
    """Views that are finished in each round that has begun."""
    work = out / ".pagas_cl"
    return [len(list(place.glob("views/*.json"))) for place in (work, *work.glob("round_*"))]


def kill_once(scene: Path, out: Path, after: float, count: int, more=(), how=signal.SIGKILL) -> bool:
    """Start the command and kill it after so many seconds, or once `count` views are written; whether it was still
    running. RuntimeError where a process that it has started outlives it by ten seconds."""
    process = subprocess.Popen(arguments(scene, out, more), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                               env=_environment())
    start = time.monotonic()
    while time.monotonic() - start < after and sum(written(out)) < count:
        if process.poll() is not None:
            return False
        time.sleep(0.002)
    started = family(process.pid)
    process.send_signal(how)
    process.wait()
    for _ in range(200):
        if not any(map(alive, started)):
            return True
        time.sleep(0.05)
    raise RuntimeError(f"{sum(map(alive, started))} processes are left of a run that was killed")


def check_whole(out: Path) -> int:
    """Every file under its final name can be read to its end; how many there are."""
    files = list(out.glob("*.npz")) if out.is_dir() else []
    for path in files:
        with np.load(path) as archive:
            if archive["depth"].shape != (48, 64):
                raise RuntimeError(f"{path} is not whole")
    return len(files)


def settle(out: Path) -> None:
    """Files of somebody else, in `out` and beside it."""
    for name in STRANGERS:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(f"somebody's {name}")


def check_others(out: Path) -> None:
    """RuntimeError where a run that has ended still holds the folder, or has touched what is not its own."""
    descriptor = locks.take(out / ".pagas_cl" / "lock") if (out / ".pagas_cl" / "lock").exists() else -1
    if descriptor is None:
        raise RuntimeError(f"{out} is locked, and nobody is at work in it")
    if descriptor >= 0:
        os.close(descriptor)
    changed = [name for name in STRANGERS if (out / name).read_text() != f"somebody's {name}"]
    if changed:
        raise RuntimeError(f"{out}: {changed} are not as they were")


def undisturbed(folder: Path, views: int = 8) -> tuple[Path, dict, float]:
    """A scene of so many views, what a run in this process gives for it, and the seconds that another would take."""
    scene = write_small_scene(folder / "scene", views)
    views, depths = load_small_scene(scene)
    start = time.monotonic()
    refine_views(views, depths, config=CONFIG, folder=folder / "whole")
    return scene, bytes_of(folder / "whole"), 2 + time.monotonic() - start


def run_trials(trials: int, folder: Path, like: tuple, seed: int = 0, more=()) -> dict:
    """Kill `trials` times; figures of what happened. `like` is what `undisturbed` gave. RuntimeError where a result is
    not as it should be."""
    rng, (scene, wanted, whole) = random.Random(seed), like
    figures = {"kills": 0, "runs": 0, "kills with some views kept": 0, "kills within a round": 0}
    total = len(wanted) * (1 + len(later_rounds(CONFIG, len(wanted))))
    while figures["kills"] < trials:
        out, killed = folder / f"run{figures['runs']}" / "out", True
        settle(out)
        while killed and figures["kills"] < trials:
            how = rng.choice((signal.SIGKILL, signal.SIGTERM))
            left, by_time = range(sum(written(out)) + 1, total), rng.random() < 0.2
            moment = ((rng.uniform(0.1 * whole, 1.05 * whole), total) if by_time or not left
                      else (math.inf, rng.choice(left)))
            killed = kill_once(scene, out, *moment, more, how)
            check_whole(out)
            check_others(out)
            figures["kills"] += killed
            figures["kills with some views kept"] += killed and 0 < sum(written(out)) < total
            figures["kills within a round"] += killed and any(0 < count < len(wanted) for count in written(out))
        run_whole(scene, out, more)
        figures["runs"] += 1
        check_others(out)
        left = [path for path in out.rglob("*") if ".part" in path.name and path.name not in STRANGERS]
        if bytes_of(out) != wanted or left:
            raise RuntimeError(f"{out} differs from the undisturbed run, or something is left beside: {left}")
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--way", choices=(*WAYS, "all"), default="in-process")
    parser.add_argument("--through-executor", nargs=2, type=Path)
    chosen = parser.parse_args()
    if chosen.through_executor:
        through_executor(*chosen.through_executor)
        return
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        like = undisturbed(Path(folder))
        for way in WAYS if chosen.way == "all" else (chosen.way,):
            tell(way, run_trials(chosen.trials, Path(folder) / way, like, chosen.seed,
                                 options(way, Path(folder), stack)))


def tell(way: str, figures: dict) -> None:
    sys.stdout.write(f"{way}: " + ", ".join(f"{name}: {n}" for name, n in figures.items()) + "; 0 failures\n")
    sys.stdout.flush()


def options(way: str, folder: Path, stack: ExitStack) -> tuple[str, ...]:
    """What the command line gets beside the rest."""
    if way == "dask":
        from test_cluster import Cluster

        (folder / "cluster").mkdir()
        cluster = Cluster(folder / "cluster", stack)
        cluster.add("127.0.0.2")
        cluster.ready(1)
        return ("--scheduler", cluster.address)
    return {"in-process": (), "devices": ("--devices", "all"), "executor": ("executor",)}[way]


if __name__ == "__main__":
    main()
