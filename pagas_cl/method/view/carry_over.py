"""Launches of carry_over.cl: what a smaller size has found, carried over to depth maps of another size (method section
8.3)."""

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.constants import SHARED
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.inputs import Depth, depth_array


@dataclass(frozen=True, eq=False)
class Movement:
    """What a smaller size, `scale` of the full one, has found: the `result` there, and the depth map (h, w) as it was
    `given`, at that size, before any size was refined."""

    given: Depth
    result: DepthResult
    scale: float


def moved_along(depth: np.ndarray, movement: Movement, device: Device) -> np.ndarray:
    """A depth map as it was given, of any size (H, W), moved along with what a smaller size has found: each depth by
    the share by which those around it moved that were of the same surface, within a pixel of parallax there."""
    with translate_cl_errors(device, "carrying depths over"):
        moved = upload(device, depth.astype(np.float32, copy=False))
        move_along(depth.shape, movement, device, moved)
        out = download(device, moved, depth.shape)
        release(moved)
    return out


def move_along(shape: tuple[int, int], movement: Movement, device: Device, depth: cl.Buffer) -> None:
    """The same of a depth map of this `shape` on the device, where it is."""
    result, (height, width) = movement.result, shape
    found = {name: upload(device, np.asarray(values, np.float32)) for name, values in (
        ("given", depth_array(movement.given)), ("depth", result.depth), ("parallax", result.parallax),
        ("deviation", result.deviation))}
    (small_height, small_width), program = result.depth.shape, build(device, "carry_over.cl", SHARED)
    moves, followed = (device.buffer(4 * numbers * small_height * small_width) for numbers in (4, 3))
    small = {"width": small_width, "height": small_height}
    program.run("find_moves", (small_width, small_height), None, {**found, **small}, moves=moves)
    program.run("follow_sure", (small_width, small_height), None, small, moves=moves, scale=movement.scale,
                followed=followed)
    program.run("carry_over", (width, height), followed=followed, small_width=small_width, small_height=small_height,
                depth=depth, width=width, height=height)
    release(*found.values(), moves, followed)
