"""Launches of starts.cl: of two depth maps to start from, the better one around each pixel (method section 8.3)."""

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.constants import SHARED
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import download, release
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Size

_STEP = 2                   # pixels between those where these are compared


def places(device: Device, size: Size) -> tuple[cl.Buffer, int]:
    """Numbers of the pixels of a depth map of `size` that are compared, int32, and how many they are."""
    known = _grid(size)
    count = known["columns"] * known["rows"]
    found = device.buffer(4 * count)
    build(device, "starts.cl", SHARED).run("list_places", (known["columns"], known["rows"]), None, known, places=found)
    return found, count


def better_of(device: Device, size: Size, depths: Sequence[cl.Buffer], costs: Sequence[cl.Buffer]) -> np.ndarray:
    """Of two `depths` of `size` on the device the first where it costs less than the second at most of the places
    around, else that, in whose buffer it is put: float32 (H, W). `costs` are Hypotheses.costs_nearby of either."""
    program, known = build(device, "starts.cl", SHARED), {**_grid(size), "one": depths[0], "other": depths[1]}
    grid = known["columns"], known["rows"]
    better = device.buffer(grid[0] * grid[1])
    program.run("compare_starts", grid, None, known, one_cost=costs[0], other_cost=costs[1], better=better)
    program.run("take_better", size, None, known, better=better, height=size.height)
    found = download(device, depths[1], size.shape)
    release(better)
    return found


def _grid(size: Size) -> dict[str, int]:
    return {"step": _STEP, "width": size.width, "columns": -(-size.width // _STEP), "rows": -(-size.height // _STEP)}
