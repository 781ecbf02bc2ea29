"""Device memory of a large frame: planned, counted here, and taken from the device as its driver reports it.

    python tests/bench/memory.py [--size 4112 3008] [--contexts 10] [--preset balanced] [--json FILE]

A made frame (ActorsHQ's size by default): one texture, seen by cameras that are moved by whole pixels of parallax over
a plane, so that the truth is exact and nothing has to be rendered. Three runs: all photos on the device; one at a time,
as PAGAS_CL_MEMORY's limit requires; one at a time because the device is nearly full (NVIDIA with PyTorch only, which
takes the rest). All three must give the same bytes. The driver's count needs NVIDIA and PyTorch, and the GPU alone.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from record import add_json, record
from support import hard_scenes as make

from pagas_cl.config.presets import preset
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View

TITLE = "Device memory"
MEASURED = ("A synthetic frame, MB: planned, counted by the program, taken by NVIDIA's driver; errors before and after "
            "in pixels of parallax; a hash of the depth, whose bytes are the same in all rows.")
PARALLAX = 24      # pixels of parallax between target and contexts


def frame(size, contexts: int):
    """Target, context views, initial depth (0.25 pixels of parallax off) and the pixel of parallax, in depth."""
    (width, height), rng = size, np.random.default_rng(0)
    border = PARALLAX + 1
    wide = make.photo(rng, (512, 512))
    wide = np.tile(wide, ((height + 2 * border) // 512 + 1, (width + 2 * border) // 512 + 1, 1))
    focal = 1.2 * width
    shifts = [(0, 0)] + [(round(PARALLAX * np.cos(a)), round(PARALLAX * np.sin(a)))
                         for a in 2 * np.pi * np.arange(contexts) / contexts]
    views = []
    for k, (x, y) in enumerate(shifts):
        camera = make.camera(size, (focal, focal), (x / focal, y / focal, 0.0), name=f"view {k}")
        photo = wide[border + y:border + y + height, border + x:border + x + width]
        views.append(View(camera, np.ascontiguousarray(photo)))
    coarse = np.kron(rng.standard_normal((height // 16 + 1, width // 16 + 1)), np.ones((16, 16)))[:height, :width]
    depth_per_parallax = 1 / PARALLAX     # at depth 1, in a view PARALLAX pixels of parallax away
    return views[0], views[1:], (1 + 0.25 * depth_per_parallax * coarse).astype(np.float32), depth_per_parallax


class Driver:
    """Least free memory of the device while this is open, as NVIDIA's driver reports it; None without PyTorch."""

    def __init__(self):
        try:
            import torch

            self._free = lambda: torch.cuda.mem_get_info()[0]
            self._start = self._free()
        except (ImportError, RuntimeError, AssertionError):
            self._free = None
        self.taken, self._open = None, True

    def __enter__(self):
        if self._free:
            self._least = self._start = self._free()
            self._thread = threading.Thread(target=self._watch)
            self._thread.start()
        return self

    def _watch(self):
        while self._open:
            self._least = min(self._least, self._free())
            time.sleep(0.001)

    def __exit__(self, *_):
        self._open = False
        if self._free:
            self._thread.join()
            self.taken = self._start - self._least


def run(name: str, given, config, device) -> dict:
    target, contexts, depth, depth_per_parallax = given
    gc.collect()
    device.memory.clear()
    with Driver() as driver:
        start = time.perf_counter()
        result = refine_depth(target, contexts, depth, config=config, device=device)
        seconds = time.perf_counter() - start
    planned, counted = (result.report[key] / 1e6 for key in ("planned_bytes", "device_bytes"))
    inner = (slice(64, -64),) * 2
    errors = [np.abs(d[inner] - 1).mean() / depth_per_parallax for d in (depth, result.depth)]
    digest = hashlib.blake2b(result.depth.tobytes(), digest_size=4).hexdigest()
    return {"photos": name, "planned": round(planned), "counted": round(counted),
            "driver": driver.taken and round(driver.taken / 1e6), "s": seconds, "error, input": errors[0],
            "error": errors[1], "depth": digest}


def fill_device(leave: float):
    """Take all of an NVIDIA device but `leave` bytes; what is returned holds it. None where that cannot be done."""
    try:
        import torch

        free, _ = torch.cuda.mem_get_info()
        return torch.empty(int(free - leave), dtype=torch.uint8, device="cuda")
    except (ImportError, RuntimeError, AssertionError):
        return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", nargs=2, type=int, default=(4112, 3008))
    parser.add_argument("--contexts", type=int, default=10)
    parser.add_argument("--preset", default="balanced")
    add_json(parser)
    chosen = parser.parse_args()
    device, config = open_device(), preset(chosen.preset)
    small = frame((256, 192), chosen.contexts)
    refine_depth(*small[:3], config=config, device=device)           # compiles
    given = frame(tuple(chosen.size), chosen.contexts)
    rows = [run("all on the device", given, config, device)]
    gc.collect()
    before, full = device.memory.limit, device.memory.peak
    try:
        device.memory.limit = full - 1
        rows.append(run("one at a time, limit", given, config, device))
    finally:
        device.memory.limit = before
    gc.collect()
    held = fill_device(0.9 * full)
    if held is not None:
        rows.append(run("one at a time, device full", given, config, device))
    frame_of = {"frame": f"{chosen.size[0]} x {chosen.size[1]}, {chosen.preset}"}
    record(TITLE, MEASURED, device.info.title, [{**frame_of, **row} for row in rows], chosen.json)
    return 0 if len({row["depth"] for row in rows}) == 1 else 1


if __name__ == "__main__":
    raise SystemExit(main())
