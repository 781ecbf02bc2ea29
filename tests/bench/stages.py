"""What a step and a frame cost on this device, stage by stage, against what the device's memory allows: README.md.

    python tests/bench/stages.py [--preset fast balanced paper] [--width 388] [--context 5] [--json FILE]

Measures presets on a synthetic scene: time of each kernel, bytes moved, share of the copy bandwidth, memory.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import pyopencl as cl
from support.synthetic import relief_scene

from pagas_cl.config import Config
from pagas_cl.config.presets import build_config
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels
from pagas_cl.method.splat.options import reach
from pagas_cl.method.splat.view import full_level
from pagas_cl.runtime.device import Device, open_device
from pagas_cl.runtime.program import Fill, Launch, Upload

_COPY_BYTES = 128 * 2**20      # of a copy that measures bandwidth; less where the device allows no such buffer


def stage_times(queue: cl.CommandQueue, launches: Sequence[Launch | Fill | Upload],
                repeats: int = 5) -> dict[str, tuple[float, int]]:
    """Run `launches` in order `repeats` times on a profiling `queue`.

    (milliseconds, launches) per repeat, by stage, from the device's own clock; one more repeat comes first and is not
    counted, since a first launch may still compile.
    """
    total: dict[str, float] = defaultdict(float)
    count: dict[str, int] = defaultdict(int)
    for repeat in range(repeats + 1):
        events = [(launch.stage, launch.enqueue(queue)) for launch in launches]
        queue.finish()
        for stage, event in events if repeat else ():
            total[stage] += (event.profile.end - event.profile.start) * 1e-6 / repeats
            count[stage] += 1
    return {stage: (total[stage], count[stage] // repeats) for stage in total}


@dataclass(frozen=True)
class Stage:
    """One kernel over one step, all its launches together.

    `megabytes` is what it must move, every input read once, every output written once (0 where that is not counted);
    `share`: of the copy bandwidth, that moving this in this time amounts to.
    """

    name: str
    launches: int
    ms: float
    megabytes: float
    share: float


@dataclass(frozen=True)
class BenchResult:
    """One preset on one device. Times of a frame are of all of it: upload of the depth, steps, judging, download."""

    preset: str
    device: str
    driver: str
    width: int
    height: int
    contexts: int
    views_per_step: int
    channels: int
    copy_gb_per_s: float
    stages: list[Stage]
    step_ms: float
    floor_ms: float
    first_frame_s: float
    frame_s: float
    steps: tuple[int, ...]
    device_mb: float

    def as_dict(self) -> dict:
        return asdict(self)

    def table(self) -> str:
        stages = "".join(
            f"{s.name:<22}{s.launches:>9}{s.ms:>11.3f}"
            + (f"{s.megabytes:>9.1f}{100 * s.share:>18.0f}%" if s.megabytes else "") + "\n" for s in self.stages)
        return (f"{self.preset}: {self.width} x {self.height}, {self.contexts} context views, {self.views_per_step} a "
                f"step, {'colour' if self.channels == 3 else 'grey'}\n{self.device}, driver {self.driver}, "
                f"copies {self.copy_gb_per_s:.0f} GB/s\n"
                f"{'stage':<22}{'launches':>9}{'ms a step':>11}{'MB':>9}{'of copy bandwidth':>19}\n{stages}"
                f"{'a step':<22}{'':>9}{self.step_ms:>11.3f}; moving its data alone {self.floor_ms:.3f} ms\n"
                f"a frame {self.frame_s:.3f} s, the first one {self.first_frame_s:.3f} s; "
                f"{' + '.join(map(str, self.steps))} steps; {self.device_mb:.0f} MB on the device\n")


def bench(views, depth, preset: str, config: Config, device=None, repeats: int = 3) -> BenchResult:
    """Measure one preset on one view: `views` are the target, then its context views; `depth` (H, W) is its initial
    z-depth, scene units, 0 = no surface."""
    opened = open_device(device)
    times = cl.command_queue_properties.PROFILING_ENABLE
    profiled = Device.of(cl.CommandQueue(opened.context, opened.cl_device, times))
    target, contexts = views[0], views[1:]
    copy = copy_bandwidth(profiled)
    stages, views_per_step = _step(profiled, target, contexts, depth, config, repeats, copy)
    photos, times = PhotoStore(opened), []
    for _ in range(1 + repeats):
        start = time.perf_counter()
        refined = refine_levels(ViewInput(target, contexts, depth, opened, photos), config)
        times.append(time.perf_counter() - start)
    info, camera = opened.info, target.camera
    return BenchResult(preset, info.title, info.driver, camera.width, camera.height, len(contexts), views_per_step,
                       1 if config.loss.grey else 3, copy / 1e9, stages, sum(s.ms for s in stages),
                       sum(s.megabytes for s in stages) * 1e9 / copy, times[0], min(times[1:]), refined.steps,
                       refined.device_bytes / 1e6)


def copy_bandwidth(device) -> float:
    """Bytes per second of a large copy on a profiling `device`, reads and writes counted."""
    nbytes = min(_COPY_BYTES, device.info.max_alloc // 4, device.info.memory // 16)
    source, target = (cl.Buffer(device.context, cl.mem_flags.READ_WRITE, nbytes) for _ in range(2))
    cl.enqueue_fill_buffer(device.queue, source, np.uint32(0x3F9D70A4), 0, nbytes // 4 * 4)
    times = []
    for _ in range(7):
        event = cl.enqueue_copy(device.queue, target, source, byte_count=nbytes)
        event.wait()
        times.append((event.profile.end - event.profile.start) * 1e-9)
    return 2 * nbytes / median(times[2:])


def _step(device, target, contexts, depth, config, repeats, copy):
    """The Stages of one step, slowest first, and the context views in it."""
    level = full_level(ViewInput(target, contexts, depth, device, PhotoStore(device)), config)
    launches = [*level.step_launches(0), *level.solver().launches]
    moved = stage_bytes(config, level.target.size.pixels, max(view.size.pixels for view in level.views))
    stages = []
    for name, (ms, count) in stage_times(device.queue, launches, repeats).items():
        fills = [launch.size for launch in launches if launch.stage == name and hasattr(launch, "size")]
        megabytes = (sum(fills) + moved.get(name, 0) * (count - len(fills))) / 1e6
        stages.append(Stage(name, count, ms, megabytes, megabytes * 1e6 / copy / (ms * 1e-3) if ms else 0.0))
    per_step = level.views_per_step
    level.release()
    return sorted(stages, key=lambda stage: -stage.ms), per_step


def stage_bytes(config: Config, n: int, m: int) -> dict[str, int]:
    """Bytes that one launch of each stage must move, for a target of `n` and a context view of `m` pixels."""
    channels = 1 if config.loss.grey else 3
    image = 4 * (channels + 1)  # with coverage; the same of what is passed back to it
    partials = 8 * channels if config.loss.ssim else 0
    first = 4 if config.splatting.occlusion else 0
    places = 4 * (2 * reach(config.splatting.radius) + 1) ** 2  # weights around a bin
    return {
        "find_landing": 4 * n, "nearest": 4 * n + 8 * m,
        "splat_order_free": 8 * n + (first + 2 * image) * m,
        "gather_gradient": 16 * n + (first + image) * m,
        "link_bins": (12 + places) * n + 8 * m, "composite_alpha": (12 + places) * n + (4 + image) * m,
        "composite_alpha_vjp": (12 + 2 * places) * n + (4 + image) * m, "gather_alpha": (12 + places) * n + 4 * m,
        "ssim_forward": (image + 4 + partials) * m, "loss_backward": (3 * image + 4 + partials) * m,
        "filter_gradient": 24 * n, "adam": 36 * n,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", nargs="+", default=["fast", "balanced", "paper"])
    parser.add_argument("--width", type=int, default=388, help="of the photos; the height is three quarters of it")
    parser.add_argument("--context", type=int, default=5, help="context views")
    parser.add_argument("--repeat", type=int, default=3, help="runs after the first, the best of which counts")
    parser.add_argument("--set", nargs="+", default=[], metavar="STAGE.FIELD=VALUE", help="for all presets")
    parser.add_argument("--device")
    parser.add_argument("--json")
    chosen = parser.parse_args()
    scene = relief_scene(chosen.width, round(chosen.width * 0.7477), contexts=chosen.context)
    depth, results = scene.initial_depth(scene.cameras[0]), []
    for name in chosen.preset:
        config = build_config(name, chosen.set)
        results.append(bench(scene.views, depth, name, config, chosen.device, chosen.repeat))
        sys.stdout.write(results[-1].table() + "\n")
    if chosen.json:
        with open(chosen.json, "w", encoding="utf-8") as file:
            json.dump({"presets": [result.as_dict() for result in results]}, file, indent=1)


if __name__ == "__main__":
    main()
