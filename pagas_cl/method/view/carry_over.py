"""Launches of carry_over.cl: what a smaller size has found, carried over to depth maps of another size (method section
8.3)."""

from dataclasses import dataclass

import numpy as np

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
    result = movement.result
    maps = {name: np.asarray(values, np.float32) for name, values in (
        ("given", depth_array(movement.given)), ("depth", result.depth), ("parallax", result.parallax),
        ("deviation", result.deviation))}
    with translate_cl_errors(device, "carrying depths over"):
        return _carried(depth, maps, movement.scale, device)


def _carried(depth: np.ndarray, maps: dict[str, np.ndarray], scale: float, device: Device) -> np.ndarray:
    """The same, of the arrays of a Movement by the names that the kernel has."""
    (height, width), (small_height, small_width) = depth.shape, maps["depth"].shape
    program, pixels = build(device, "carry_over.cl", SHARED), small_height * small_width
    found = {name: upload(device, values) for name, values in maps.items()}
    moves, followed = (device.buffer(4 * numbers * pixels) for numbers in (4, 3))
    moved = upload(device, depth.astype(np.float32, copy=False))
    program.run("find_moves", (pixels,), None, found, count=pixels, moves=moves)
    program.run("follow_sure", (small_width, small_height), moves=moves, width=small_width, height=small_height,
                scale=scale, followed=followed)
    program.run("carry_over", (width, height), followed=followed, small_width=small_width, small_height=small_height,
                depth=moved, width=width, height=height)
    out = download(device, moved, depth.shape)
    release(*found.values(), moves, followed, moved)
    return out
