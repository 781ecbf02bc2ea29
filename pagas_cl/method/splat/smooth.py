"""Launches of smooth.cl: what holds a depth map together where photos say little (method section 5)."""

import numpy as np

from pagas_cl.method.splat.buffers import SUM_GROUPS
from pagas_cl.method.splat.constants import PENALTY_GROUP, SPECULAR_PLACE
from pagas_cl.runtime.program import Upload

AROUND = 3                           # samples around a specular one that are not trusted either


def before_steps(programs, buffers, target) -> list:
    """Once a level: buffers.kappa, and buffers.weights, the weight of each pixel by its texture."""
    s = programs.config.smoothness
    if s.kind == "none":
        return []
    return [programs.bind("smooth.cl", "smoothness_scale", target.size, buffers, target,
                          texture=1.0 if s.kind == "normal" else s.texture)]


def raising(programs, buffers, target, specularity) -> list:
    """Once a level, after `before_steps`: more of buffers.weights where a surface is specular (LevelInput)."""
    if buffers.raised is None or specularity is None:
        return []
    down, across = specularity.shape
    return [Upload(buffers.raised, factors_of(specularity, float(programs.config.smoothness.specularity))),
            programs.bind("smooth.cl", "raise_weights", target.size, buffers, target, factors=buffers.raised,
                          across=across, down=down)]


def factors_of(specularity: np.ndarray, most: float) -> np.ndarray:
    """By how much specularity (grid, NaN = unknown) raises the weights there and around: float32, 1 to `most`."""
    padded, (down, across) = np.pad(np.where(np.isnan(specularity), 0, specularity), AROUND), specularity.shape
    shifts = range(2 * AROUND + 1)
    rows = np.maximum.reduce([padded[k:k + down] for k in shifts])      # an axis at a time: an eighth of the time
    largest = np.maximum.reduce([rows[:, k:k + across] for k in shifts])
    return np.clip((largest / SPECULAR_PLACE) ** 2, 1.0, most).astype(np.float32)


def launches(programs, buffers, target, weight: float) -> list:
    """Add N dL_s/dd of "normal" smoothness to the gradient that a step follows (that of "planar" is in it), and L_s to
    the loss where the schedule follows it; once a step."""
    s, size = programs.config.smoothness, target.size
    if s.kind == "none" or s.weight == 0:
        return []

    def smooth(kernel, grid=size, group=None, **arguments):
        return programs.bind("smooth.cl", kernel, grid, buffers, target, group, **arguments)

    planar = {"h": s.huber, "discontinuity": s.discontinuity} if s.kind == "planar" else None
    slopes = [] if planar else [smooth("normal_map"), smooth("normal_slope", scale=weight),
                                smooth("normal_vjp", gradient=buffers.followed or buffers.gradient)]
    if buffers.smooth_losses is None:
        return slopes
    return [*slopes, smooth("planar_loss" if planar else "normal_loss", (SUM_GROUPS * PENALTY_GROUP,), (PENALTY_GROUP,),
                            partials=buffers.smooth_losses, **(planar or {})),
            programs.bind("step.cl", "add_smoothness", (1,), buffers, partials=buffers.smooth_losses, count=SUM_GROUPS,
                          scale=weight / size.pixels)]
