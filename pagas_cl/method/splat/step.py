"""Launches of step.cl, Adam and its schedule (method section 6); and progress of what the device has done."""

from collections import deque

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.constants import BEST, DONE, LOSS, LOSS_ONE, RATE
from pagas_cl.runtime.memory import constant, download

_LOOK_EVERY = 10          # steps between two looks of the host at the schedule
AHEAD = 8          # steps that stay enqueued beyond the one that is reported: the device never waits for the host


def loss_of(device, buffers) -> float:
    """What the schedule follows, of the gradient made last; it has to be followed (solver.patience)."""
    return float(download(device, buffers.loss, 1, np.int64)[0] / LOSS_ONE + download(device, buffers.state, 8)[LOSS])


class Solver:
    """Adam over buffers.depth, of `size`; the rate lives on the device, where the schedule changes it."""

    def __init__(self, programs, buffers, size, viewing_distance: float):
        self.device, self.buffers, self.settings = programs.device, buffers, programs.config.solver
        solver = self.settings
        state = np.zeros(8, np.float32)
        state[RATE], state[BEST] = solver.rate, np.inf
        cl.enqueue_copy(self.device.queue, buffers.state, constant(self.device, state))
        self._adam = programs.bind(
            "step.cl", "adam", (size.pixels,), buffers, followed=buffers.followed or buffers.gradient,
            count=size.pixels, first_scale=1.0, second_scale=1.0, beta1=solver.beta1, beta2=solver.beta2,
            damping=solver.damping, share=1.0,
            common_length=viewing_distance if solver.rate_unit == "distance" else 0.0)
        self.launches = [self._adam]        # what ends a step
        if solver.patience:
            self._plateau = programs.bind(
                "step.cl", "plateau", (1,), buffers, photo_loss=buffers.loss, number=1, patience=solver.patience,
                floor_rate=solver.rate * solver.rate_floor * 0.999)      # a rate that reaches the floor still counts
            self.launches.append(self._plateau)

    def enqueue(self, number: int, steps: int):
        """Step `number` (from 0) of `steps`; returns the event that ends it."""
        settings = self.settings
        if settings.patience:
            self._plateau.set(number=number + 1)
            self._plateau.enqueue(self.device.queue)
        self._adam.set(first_scale=1 / (1 - settings.beta1 ** (number + 1)),
                       second_scale=1 / (1 - settings.beta2 ** (number + 1)),
                       damping=settings.damping_at(number, steps), share=self._share(number, steps))
        return self._adam.enqueue(self.device.queue)

    def rate(self, number: int, steps: int) -> float:
        """Of step `number`, before the schedule lowers it: how far a depth goes at most, where beta1 is beta2."""
        return self.settings.rate * self._share(number, steps)

    def _share(self, number: int, steps: int) -> float:
        """Of the rate, at step `number`: 1 over the first half, then linearly down to final_rate."""
        late = max(0.0, 2 * (number + 1) / steps - 1)
        return 1 + late * (self.settings.final_rate - 1)

    def finished(self, number: int) -> bool:
        """Whether the schedule has ended the level; looked up only every few steps, since it waits for the device."""
        if not self.settings.patience or (number + 1) % _LOOK_EVERY:
            return False
        return bool(download(self.device, self.buffers.state, 8)[DONE])


class StepProgress:
    """Calls `on_step(done, total)` when a step has ended on the device; does nothing where that is None."""

    def __init__(self, on_step, total: int):
        self._on_step, self._total, self._under_way = on_step, total, deque()

    def enqueued(self, number: int, event):
        """Step `number` (from 1) was; `event` ends it."""
        if self._on_step:
            self._under_way.append((number, event))
        while len(self._under_way) > AHEAD:
            self._wait()

    def finish(self):
        while self._under_way:
            self._wait()

    def _wait(self):
        number, event = self._under_way.popleft()
        event.wait()
        self._on_step(number, self._total)
