"""Launches of smooth.cl: what holds a depth map together where photos say little (method section 5)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.constants import PENALTY_GROUP, SPECULAR_PLACE

AROUND = 3                           # samples around a specular one that are not trusted either
SUM_GROUPS = 64                      # groups that share the pixels


def before_steps(level) -> list:
    """Once a level: pixels of parallax per inverse depth, and the weight of each pixel by its texture."""
    s = level.config.smoothness
    if s.kind == "none":
        return []
    a, size = level.arena, level.target
    texture = 1.0 if s.kind == "normal" else float(s.texture)
    program = build(level.device, "smooth.cl", level.defines)
    scale = bind(program, "smoothness_scale", size.grid, None, a["depth"], a["depth_per_parallax"],
                 level.given.photos[0], size.width,
                 size.height, texture, a["kappa"], a["weights"])
    if _glossy(level):
        cl.enqueue_copy(level.device.queue, a["raised"], factors_of(level.given.specularity, float(s.specularity)))
    return [scale]


def raising(level) -> list:
    """Once a level, after `before_steps`: more weight where a surface is specular."""
    a, size = level.arena, level.target
    if not _glossy(level):
        return []
    return [bind(build(level.device, "smooth.cl", level.defines), "raise_weights", size.grid, None, a["raised"],
                 *level.given.specularity.shape[::-1], *size.grid, a["weights"])]


def _glossy(level) -> bool:
    s = level.config.smoothness
    return s.kind != "none" and s.specularity > 0 and level.given.specularity is not None


def factors_of(specularity: np.ndarray, most: float) -> np.ndarray:
    """By how much specularity, measured on a grid (NaN = unknown), raises the weights there and around:
    float32, 1 to `most`.
    """
    padded = np.pad(np.nan_to_num(specularity, nan=0.0), AROUND)
    side = range(2 * AROUND + 1)
    largest = np.max([padded[y:y + specularity.shape[0], x:x + specularity.shape[1]] for y in side for x in side],
                     axis=0)
    return np.clip((largest / SPECULAR_PLACE) ** 2, 1.0, most).astype(np.float32)


def launches(level, weight: float) -> list:
    """Add N dL_s/dd to arena["gradient"], and L_s to the loss where the schedule follows it; once a step."""
    s, a, size = level.config.smoothness, level.arena, level.target
    if s.kind == "none" or s.weight == 0:
        return []
    program = build(level.device, "smooth.cl", level.defines)
    if s.kind == "planar":
        return [bind(program, "smoothness_planar", size.grid, None, a["depth"], a["kappa"], a["weights"], size.width,
                     size.height, weight, float(s.huber), float(s.discontinuity), a["gradient"]), *_loss(level, weight)]
    return [bind(program, "normal_map", size.grid, None, a["depth"], a["cameras"], a["normals"]),
            bind(program, "normal_slope", size.grid, None, a["normals"], a["weights"], size.width, size.height,
                 weight, a["slopes"]),
            bind(program, "normal_vjp", size.grid, None, a["depth"], a["cameras"], a["slopes"], a["gradient"]),
            *_loss(level, weight)]


def _loss(level, weight: float) -> list:
    """L_s to the schedule's loss."""
    s, a, size = level.config.smoothness, level.arena, level.target
    if "smooth_losses" not in a:
        return []
    program, grid = build(level.device, "smooth.cl", level.defines), (SUM_GROUPS * PENALTY_GROUP,)
    shared = a["weights"], size.width, size.height
    summed = (bind(program, "planar_loss", grid, (PENALTY_GROUP,), a["depth"], a["kappa"], *shared, float(s.huber),
                   float(s.discontinuity), a["smooth_losses"]) if s.kind == "planar" else
              bind(program, "normal_loss", grid, (PENALTY_GROUP,), a["normals"], *shared, a["smooth_losses"]))
    return [summed, bind(build(level.device, "step.cl", level.defines), "add_smoothness", (1,), None,
                         a["smooth_losses"], SUM_GROUPS, weight / size.pixels, a["state"])]
