"""Whether time is linear in pixels, steps and views.

    python tests/bench/scenes.py SCENES
    python tests/bench/scaling.py SCENES/relief OUT.md [--device gpu]

Fits the exponent of time against each over a range of 16, the others fixed (photos are resized: for times, not for
errors). "A view": from photos on the device to the depth on the host. "Its steps": that less the same with no step,
which is what grows with steps and views.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from front import case_of
from PIL import Image

from pagas_cl.app.tradeoffs.case import loaded
from pagas_cl.app.tradeoffs.plan import fixed
from pagas_cl.method.splat import PhotoStore, refine_levels
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.depthmap import resize_depth
from pagas_cl.scene.view import View

BASE = fixed("balanced")
REPEATS = 4


@dataclass(frozen=True, eq=False)
class Scene:
    """A target, context views and the initial depth (H, W)."""

    target: View
    contexts: list[View]
    depth: np.ndarray

    @classmethod
    def read(cls, folder: Path) -> Scene:
        case = loaded(case_of(folder))
        return cls(case.target, case.contexts, case.initial)

    @property
    def pixels(self) -> int:
        return self.depth.size

    def resized(self, share: float) -> Scene:
        """Every image `share` times as wide and as high."""
        def view(old):
            size = round(old.camera.width * share), round(old.camera.height * share)
            return View(old.camera.resized(*size), np.asarray(Image.fromarray(old.load_image()).resize(size)))

        target = view(self.target)
        depth = resize_depth(self.depth, target.camera.width, target.camera.height)
        return Scene(target, [view(v) for v in self.contexts], depth)

    def seconds(self, config, device) -> tuple[float, float]:
        """The least of some times of a view, and of its steps alone."""
        photos = PhotoStore(device)

        def least(settings):
            times = []
            for _ in range(1 + REPEATS):  # the first one compiles and uploads
                start = time.perf_counter()
                refine_levels(self.target, self.contexts, self.depth, settings, device, photos)
                times.append(time.perf_counter() - start)
            return min(times[1:])

        whole = least(config)
        return whole, whole - least(config.with_settings(pyramid__steps=(0,)))


def fitted_exponent(sizes, seconds) -> float:
    """Slope of log(seconds) over log(sizes): 1 where time is linear in size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def against_pixels(scene: Scene, device):
    scenes = [scene.resized(share) for share in (1, 2**0.5, 2, 2**1.5, 4)]
    sizes = f"{scenes[0].target.camera.width} to {scenes[-1].target.camera.width} pixels wide"
    return f"pixels, {sizes}", [s.pixels for s in scenes], [s.seconds(BASE, device) for s in scenes]


def against_steps(scene: Scene, device):
    counts = [25, 50, 100, 200, 400]
    return "steps", counts, [scene.seconds(BASE.with_settings(pyramid__steps=(n,)), device) for n in counts]


def against_views(scene: Scene, first: int, device):
    counts, times = [first * 2**k for k in range(5)], []
    for n in counts:
        some = replace(scene, contexts=(scene.contexts * n)[:n])
        config = BASE.with_settings(context__number=n, solver__views_per_step=0, pyramid__steps=(50,))
        times.append(some.seconds(config, device))
    return f"views in every step, {first} to {counts[-1]}", counts, times


def table(rows) -> str:
    """One line for a whole view and one for its steps, for each of (name, values, (whole, steps) of each value)."""
    lines = ["| against | time of | values | seconds | exponent |", "|---|---|---|---|---|"]
    for name, values, times in rows:
        for part, taken in zip(("a view", "its steps"), np.transpose(times)):
            cells = name, part, *(", ".join(f"{v:.4g}" for v in some) for some in (values, taken))
            lines.append("| " + " | ".join([*cells, f"{fitted_exponent(values, taken):.3f}"]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--device")
    given = parser.parse_args()
    device, scene = open_device(given.device), Scene.read(given.scene)
    few = replace(scene, contexts=scene.contexts[:4])
    rows = [against_pixels(few.resized(0.25), device), against_pixels(few, device), against_steps(scene, device),
            against_views(scene, 1, device), against_views(scene, 4, device)]
    given.out.write_text(f"{device.info}\n\n{table(rows)}")


if __name__ == "__main__":
    main()
