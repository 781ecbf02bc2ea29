"""Launches of step.cl: Adam and its schedule (method section 6)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.constants import BEST, DONE, LOSS, LOSS_ONE, RATE

_LOOK_EVERY = 10          # steps between two looks of the host at the schedule


def loss_of(level) -> float:
    """What the schedule follows, of the gradient made last; it has to be followed (solver.patience)."""
    return float(level.read("loss", 1, np.int64)[0] / LOSS_ONE + level.read("state", 8)[LOSS])


def loss_argument(level):
    """Where the tiles of a view add their losses; None where the schedule does not follow them."""
    return level.arena["loss"] if "loss" in level.arena else None


class Solver:
    """Adam over arena["depth"]; the rate lives on the device, where the schedule changes it."""

    def __init__(self, level):
        self.level, a, solver = level, level.arena, level.config.solver
        self.queue, self.patience = level.device.queue, solver.patience
        state = np.zeros(8, np.float32)
        state[RATE], state[BEST] = solver.rate, np.inf
        cl.enqueue_copy(self.queue, a["state"], state)
        program = build(level.device, "step.cl", level.defines)
        common = level.given.viewing_distance if solver.rate_unit == "distance" else 0.0
        n = level.target.pixels
        self._adam = bind(program, "adam", (n,), None, a["depth"], a["gradient"], a["first"], a["second"],
                         a["depth_per_parallax"],
                          a["state"], n, 1.0, 1.0, float(solver.beta1), float(solver.beta2), float(solver.damping),
                          float(common), 1.0)
        if self.patience:
            floor = solver.rate * solver.rate_floor * 0.999      # a rate that reaches the floor still counts
            self._plateau = bind(program, "plateau", (1,), None, a["state"], a["loss"], a["history"], 1, self.patience,
                                 float(floor))

    @property
    def launches(self) -> list:
        """Everything that ends a step."""
        return [self._plateau, self._adam] if self.patience else [self._adam]

    def enqueue(self, number: int, steps: int):
        """Step `number` (from 0) of `steps`; returns the event that ends it."""
        if self.patience:
            self._plateau.set_arg(3, np.int32(number + 1))
            self._plateau.enqueue(self.queue)
        settings = self.level.config.solver
        corrections = (1 / (1 - beta ** (number + 1)) for beta in (settings.beta1, settings.beta2))
        damping = settings.damping_at(number, steps)
        for argument, value in zip((7, 8, 11, 13), (*corrections, damping, self._share(number, steps))):
            self._adam.set_arg(argument, np.float32(value))
        return self._adam.enqueue(self.queue)

    def _share(self, number: int, steps: int) -> float:
        """Of the rate, at step `number`: 1 over the first half, then linearly down to final_rate."""
        late = max(0.0, 2 * (number + 1) / steps - 1)
        return 1 + late * (self.level.config.solver.final_rate - 1)

    def finished(self, number: int) -> bool:
        """Whether the schedule has ended the level; asked only every few steps, since it waits for the device."""
        if not self.patience or (number + 1) % _LOOK_EVERY:
            return False
        return bool(self.level.read("state", 8)[DONE])
