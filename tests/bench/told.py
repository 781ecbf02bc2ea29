"""Time left as commands tell it, against the time that was left; and each command's time and most host memory.

    python tests/bench/told.py                                  # makes scenes, five kinds of run, a table
    python tests/bench/told.py --kinds fast balanced --width 1554 --views 12
    python tests/bench/told.py --record FILE -- refine SCENE --mesh M --output O      # one command: FILE as JSON

What a run told is looked at when 10, 50 and 90 % of its time had gone. On a machine that has other work to do times
come and go: repeat it (--times), or let the runs go by the clock of their own processor time, PoCL's on one core
(--clock cpu). What a run takes is remembered for the next one: with an empty folder as XDG_CACHE_HOME the first one of
each kind is one with nothing built and nothing known.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from math import ceil, sqrt
from pathlib import Path

import numpy as np

SHARES = (0.1, 0.5, 0.9)


def record(file: Path, arguments: list[str], stop_at: float, clock) -> int:
    """Run a command here, and write what its progress said and what the run took; it ends at once when `stop_at` views
    are refined. `clock` tells the seconds since the process began."""
    from pagas_cl.__main__ import run
    from pagas_cl.commands import _console
    from pagas_cl.outlook import Outlook

    told = []

    class Recorder(Outlook):
        def __init__(self):
            super().__init__(clock)

        def expect(self, *given):
            super().expect(*given)
            told.append((clock(), "start", 0, 1, self.left()))

        def __call__(self, stage, done, total):
            super().__call__(stage, done, total)
            told.append((self.now, stage, done, total, self.left()))
            if stage == "refine" and done >= stop_at:
                os._exit(0)

    _console.Lines = Recorder
    status = run(arguments)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    file.write_text(json.dumps({"status": status, "seconds": clock(), "told": told,
                                "cpu": usage.ru_utime + usage.ru_stime, "mb": most_memory()}))
    return status


def most_memory() -> float:
    """MB that this process held at most (Linux); what getrusage tells begins with what its parent held."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:"))


def processor_time() -> float:
    """Seconds of this process and of those that it waited for: PoCL links each kernel that it builds by another one."""
    return sum(os.times()[:4])


def run_one(arguments: list[str], folder: Path, clock: str, stop_at: float = float("inf")) -> dict:
    """The same in a process of its own; what it wrote to standard error is in `said`."""
    file = folder / "told.json"
    command = [sys.executable, __file__, "--record", str(file), "--stop-at", str(stop_at), "--clock", clock,
               "--began", str(time.time())]
    done = subprocess.run([*command, "--", *arguments], capture_output=True, text=True)
    if stop_at < float("inf"):
        return {}
    if done.returncode:
        raise SystemExit(done.stderr)
    return {**json.loads(file.read_text()), "said": done.stderr}


def compared(found: dict) -> list[tuple[float, float]]:
    """(left, told) at each of SHARES, seconds: what was told last counts down until it is told anew."""
    at, left = (np.array([row[k] for row in found["told"]]) for k in (0, 4))
    pairs = []
    for share in SHARES:
        now = share * found["seconds"]
        last = int(np.searchsorted(at, now, "right")) - 1
        pairs.append((found["seconds"] - now, max(0.0, left[last] - (now - at[last])) if last >= 0 else float("nan")))
    return pairs


def stages(found: dict) -> str:
    """Seconds of each stage, in words."""
    took, before = dict[str, float](), 0.0
    under = "start"
    for at, stage, done, *_ in found["told"]:
        owner = under if done == 0 else stage
        took[owner] = took.get(owner, 0.0) + at - before
        before, under = at, stage
    took["end"] = found["seconds"] - before
    return ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in took.items() if seconds >= 0.05)


def make(folder: Path, width: int, height: int, views: int) -> Path:
    """Photos of a made relief under a square of cameras (rendered small, enlarged: for times alone), cameras, and the
    mesh to start from."""
    from PIL import Image

    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.mesh_file import write_mesh
    from pagas_cl.scene.readers import camera_file
    from pagas_cl.scene.view import View
    from pagas_cl.synthetic import relief_scene
    from pagas_cl.synthetic.layout import camera_at

    part = max(1, width // 388)
    made, side = relief_scene(width // part, height // part, contexts=1, held_out=0), ceil(sqrt(views))
    made = replace(made, cameras=[camera_at(made.relief, f"{k:03d}", 0.6 * (k % side - (side - 1) / 2),
                                            0.6 * (k // side - (side - 1) / 2)) for k in range(views)])
    (folder / "images").mkdir(parents=True)
    for k, camera in enumerate(made.cameras):
        photo = Image.fromarray(made.image(k)).resize((width, height), Image.BICUBIC)
        photo.save(folder / "images" / f"{camera.name}.png")
    camera_file.write(folder, [View(c.resized(width, height), Path(f"{c.name}.png"), None, f"{c.name}.png")
                               for c in made.cameras])
    write_mesh(folder / "coarse.ply", Surface(*made.initial_mesh(4.0 / part)))
    return folder


def kinds(folder: Path, scene: Path, small: Path) -> dict[str, tuple[list[str], float]]:
    """Arguments of each kind of run; and after how many views an earlier one of it is killed, 0: there is none."""
    mesh = [str(scene), "--mesh", str(scene / "coarse.ply")]
    out = {name: ["--output", str(folder / f"{name}.ply")] for name in ("fast", "balanced", "resumed", "small")}
    return {
        "fast": (["refine", *mesh, *out["fast"], "--preset", "fast"], 0),
        "balanced": (["refine", *mesh, *out["balanced"], "--report", str(folder / "report")], 0),
        "resumed": (["refine", *mesh, *out["resumed"], "--save-depth", str(folder / "kept")], 3.5),
        "analyze": (["analyze", *mesh], 0),
        "small": (["refine", str(small), "--mesh", str(small / "coarse.ply"), *out["small"]], 0),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", type=Path)
    parser.add_argument("--stop-at", type=float, default=float("inf"))
    parser.add_argument("--began", type=float, default=time.time())
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--kinds", nargs="+", default=["fast", "balanced", "resumed", "analyze", "small"])
    parser.add_argument("--width", type=int, default=518)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("arguments", nargs="*")
    ask = parser.parse_args()
    if ask.record:
        clock = processor_time if ask.clock == "cpu" else lambda: time.time() - ask.began
        return record(ask.record, ask.arguments, ask.stop_at, clock)
    if ask.clock == "cpu":
        os.environ["POCL_MAX_PTHREAD_COUNT"] = "1"      # as many seconds as of that clock
    print("| run | s | s of CPU | MB | left and told at 10 %, s | at 50 % | at 90 % | stages, s |\n" + "|---" * 8 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scene = make(folder / "scene", ask.width, round(ask.width * 0.748), ask.views)
        small = make(folder / "small", 160, 120, 24) if "small" in ask.kinds else folder
        for number in range(ask.times):
            place = folder / f"run{number}"
            place.mkdir()
            for name, (arguments, stop_at) in kinds(place, scene, small).items():
                if name not in ask.kinds:
                    continue
                if stop_at:
                    run_one(arguments, place, ask.clock, stop_at)
                found = run_one(arguments, place, ask.clock)
                cells = [f"{left:.3g}, {told:.3g}" for left, told in compared(found)]
                print(f"| {name} | {found['seconds']:.0f} | {found['cpu']:.0f} | {found['mb']:.0f} | "
                      f"{' | '.join(cells)} | {stages(found)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
