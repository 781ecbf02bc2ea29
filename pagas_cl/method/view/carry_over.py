"""What a smaller size of all views has found, carried over to depth maps of another size (method section 8.3)."""

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.carry_over import follow
from pagas_cl.result import DepthResult
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.scene.camera import Size
from pagas_cl.scene.inputs import Depth, depth_array


@dataclass(frozen=True, eq=False)
class Movement:
    """What a smaller size, `scale` of the full one, has found: `result`, and the depth map `given` there at first."""

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
    found = [upload(device, np.asarray(values, np.float32)) for values in (
        depth_array(movement.given), result.depth, result.parallax, result.deviation)]
    small = Size(*result.depth.shape[::-1])
    follow(device, small, movement.scale, *found).carry_over(device, depth, Size(width, height))
    release(*found)
