"""Kill `pagas-cl refine` at random times, start it again with the same command, compare with an undisturbed run.

    PYTHONPATH=tests python -m support.kill_trials --trials 50

One trial is one SIGKILL. A run is killed again and again until it finishes by itself; then the next one begins.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from support.job_scenes import bytes_of, write_small_scene

COMMAND = [sys.executable, "-m", "pagas_cl", "refine"]


def arguments(scene: Path, out: Path, more=()) -> list[str]:
    return [*COMMAND, str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth", str(out), "--quiet",
            "--set", "pyramid.steps=60", *more]


def run_whole(scene: Path, out: Path, more=()) -> float:
    """Run undisturbed; seconds it took."""
    start = time.monotonic()
    done = subprocess.run(arguments(scene, out, more), capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    return time.monotonic() - start


def kill_once(scene: Path, out: Path, after: float, more=()) -> bool:
    """Start the command and kill it after so many seconds; whether it was still running."""
    process = subprocess.Popen(arguments(scene, out, more), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(after)
        return False
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True


def check_whole(out: Path) -> int:
    """Every file under its final name can be read to its end; how many there are."""
    files = list(out.glob("*.npz")) if out.is_dir() else []
    for path in files:
        with np.load(path) as archive:
            if archive["depth"].shape != (48, 64):
                raise RuntimeError(f"{path} is not whole")
    return len(files)


def run_trials(trials: int, folder: Path, seed: int = 0, more=()) -> dict:
    """Kill `trials` times; figures of what happened. RuntimeError where a result is not as it should be."""
    rng, scene = random.Random(seed), write_small_scene(folder / "scene")
    whole = run_whole(scene, folder / "whole", more)
    whole = min(whole, run_whole(scene, folder / "whole again", more))
    wanted, figures = bytes_of(folder / "whole"), {"kills": 0, "runs": 0, "kills with some views finished": 0}
    while figures["kills"] < trials:
        out, killed = folder / f"run{figures['runs']}", True
        while killed and figures["kills"] < trials:
            killed = kill_once(scene, out, rng.uniform(0.1 * whole, 1.05 * whole), more)
            finished = check_whole(out)
            figures["kills"] += killed
            figures["kills with some views finished"] += killed and 0 < finished < len(wanted)
        run_whole(scene, out, more)
        figures["runs"] += 1
        left = [path for path in out.rglob("*") if path.name.endswith(".part")]
        if bytes_of(out) != wanted or left:
            raise RuntimeError(f"{out} differs from the undisturbed run, or something is left beside: {left}")
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = run_trials(chosen.trials, Path(folder), chosen.seed)
    sys.stdout.write(", ".join(f"{name}: {number}" for name, number in figures.items()) + "; 0 failures\n")


if __name__ == "__main__":
    main()
