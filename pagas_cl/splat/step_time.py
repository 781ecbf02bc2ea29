"""How long a step takes on this device, and what it needs: what an effect costs is the difference of two of these."""

import time
from dataclasses import dataclass

import numpy as np

from pagas_cl.config import Config
from pagas_cl.splat.level import Schedule
from pagas_cl.splat.photos import PhotoStore
from pagas_cl.splat.view import full_level

_ROUNDS = 3


@dataclass(frozen=True)
class StepTime:
    """`seconds` of one step at full size, the best of some rounds; `device_bytes` of the level, photos not counted."""

    seconds: float
    device_bytes: int

    def view_seconds(self, config: Config) -> float:
        """Of all steps of a view: work is proportional to the pixels of a level."""
        return self.seconds * sum(scale**2 * steps for scale, steps in zip(config.pyramid.scales, config.pyramid.steps))


def time_step(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore | None = None,
              steps: int = 5) -> StepTime:
    """Time some steps of the full-size level; parameters as in refine_levels, every effect settled."""
    # a level has room for the losses of as many steps as it is made for
    config = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(steps,))
    level = full_level(target, contexts, depth, config, device, photos)
    best, settled = np.inf, Schedule.of(config, steps).settled        # fits are a few of all steps, not of these
    for _ in range(1 + _ROUNDS):          # the first one compiles
        device.queue.finish()
        start = time.perf_counter()
        level.run(steps, schedule=settled)
        device.queue.finish()
        best = min(best, time.perf_counter() - start)
    needed = sum(buffer.size for buffer in level.buffers.held())
    level.release()
    return StepTime(best / steps, needed)
