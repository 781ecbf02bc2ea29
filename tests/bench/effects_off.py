"""Does an effect that is off cost anything? The kernels of a step against those of sources that never had it.

    python tests/bench/effects_off.py [--width 1554] [--device NAME] [--out FILE.md]

tests/splat/test_effects_off.py shows that the programs are equal but for parameters that nothing reads; here both are
timed on the device's own clock, in turn, so that neither has a warmer device.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from support.effects import COMPILED
from support.stripped import never_had

from pagas_cl.app.synthetic.layout import Relief, make_cameras
from pagas_cl.config import Effects
from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import options
from pagas_cl.method.splat import view as refinement
from pagas_cl.runtime import program
from pagas_cl.runtime.device import open_device
from pagas_cl.runtime.program import stage_times
from pagas_cl.scene.view import View

ROUNDS, REPEATS = 7, 20


@contextmanager
def as_if_never_written(effect, device):
    """Programs built meanwhile are those of sources without the effect, and launches hand over what they still take."""
    source, bind, programs = program.source, program.bind, device.programs

    def bare_bind(built, kernel, size, group, known, **arguments):
        there = built.signatures[kernel]
        return bind(built, kernel, size, group, known, **{k: v for k, v in arguments.items() if k in there})

    program.source, options.bind = lambda name: never_had(effect, name, source(name)), bare_bind
    device.programs = {}
    try:
        yield
    finally:
        program.source, options.bind = source, bind
        device.programs = programs


def level_of(device, config, views, depth):
    return refinement.full_level(views[0], views[1:], depth, config, device)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=1554)
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    device, rng = open_device(given.device, profiling=True), np.random.default_rng(0)
    cameras = make_cameras(Relief(width=given.width, height=given.width * 3 // 4, contexts=2))
    views = [View(c, rng.integers(0, 256, (c.height, c.width, 3), np.uint8), None, c.name) for c in cameras]
    depth = np.full((cameras[0].height, cameras[0].width), 650, np.float32)
    depth += 5 * np.sin(np.arange(depth.shape[1], dtype=np.float32) / 40)
    lines = ["| effect, off | step, ms | the same, never written, ms | ratio |", "|---|---|---|---|"]
    for effect in COMPILED:
        as_set = {f"effects__{name}": "set" for name in vars(Effects())}
        config = BALANCED.with_settings(**COMPILED[effect].off, **as_set)
        level = level_of(device, config, views, depth)
        with as_if_never_written(effect, device):
            bare = level_of(device, config, views, depth)
        times = np.array([[sum(ms for ms, _ in stage_times(device.queue, one.step_launches(0), REPEATS).values())
                           for one in (level, bare)] for _ in range(ROUNDS)])
        have, lack = np.median(times, axis=0)
        half_range = np.ptp(times[:, 0] / times[:, 1]) / 2
        lines.append(f"| {effect} | {have:.4f} | {lack:.4f} | {have / lack:.4f} ± {half_range:.4f} |")
        print(lines[-1], flush=True)
        level.release()
        bare.release()
    if given.out:
        given.out.write_text("\n".join([f"Measured on {device.info}, {given.width} x {given.width * 3 // 4} pixels.",
                                        "", *lines, ""]))


if __name__ == "__main__":
    main()
