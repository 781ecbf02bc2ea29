"""Which depths other views confirm (method section 7), on a device, or in NumPy where there is none."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import DeviceMemoryError, InputError
from pagas_cl.reference import agree as twin
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.rig import camera_table

log = logging.getLogger("pagas_cl")


class DepthMaps:
    """Depth maps on the device, each uploaded once; the one unused for longest goes when a
    quarter of memory is taken."""

    def __init__(self, device):
        self.device, self.limit, self._held = device, device.memory.limit // 4, {}

    def map(self, depth: np.ndarray):
        """Buffer of float32 of `depth`."""
        from pagas_cl.runtime.transfer import upload

        held = self._held.pop(id(depth), None)
        if held is None:
            pixels = np.ascontiguousarray(depth, np.float32)
            while self._held and sum(buffer.size for _, buffer in self._held.values()) + pixels.nbytes > self.limit:
                self._held.pop(next(iter(self._held)))
            held = depth, upload(self.device, pixels)
        self._held[id(depth)] = held       # the array is held so that its id stays its own
        return held[1]


def counts(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray | None],
           pixels: float = 2.0, device=None, maps: DepthMaps | None = None) -> tuple[np.ndarray, np.ndarray]:
    """How many other views confirm each depth, and how many should see it.

    Parameters
    ----------
    target : Camera
    depth : ndarray of shape (H, W)
        Its depth map, 0 = no surface.
    cameras, depths : lists of the same length
        The other views, without the target; None where a view has no depth map.
    pixels : float
        Tolerance, pixels of parallax.
    device : Device, optional
        Where to compare; in NumPy by default.
    maps : DepthMaps, optional
        Depth maps that are on the device already.

    Returns
    -------
    Two arrays of shape (H, W), uint16; 0 where there is no surface; no view confirms where there is no parallax
    """
    if len(cameras) != len(depths):
        raise InputError(f"there are {len(cameras)} cameras and {len(depths)} depth maps, expected one each")
    for camera, other in [(target, depth), *zip(cameras, depths)]:
        if other is not None and other.shape != (camera.height, camera.width):
            raise InputError(f"depth map of {camera.name!r} is {other.shape[1]} x {other.shape[0]}, its camera says "
                             f"{camera.width} x {camera.height}")
    used = [(camera, other) for camera, other in zip(cameras, depths) if other is not None]
    if device is None:
        return twin.count(target, depth, [camera for camera, _ in used], [other for _, other in used], pixels)
    from pagas_cl.runtime.faults import translate_cl_errors

    try:
        with translate_cl_errors(device, f"the comparison of view {target.name!r} with others"):
            return _on_device(target, depth, used, pixels, device, maps or DepthMaps(device))
    except DeviceMemoryError as error:
        log.warning("%s: its depths are compared on the host", str(error))
        return twin.count(target, depth, [camera for camera, _ in used], [other for _, other in used], pixels)


def _on_device(target, depth, used, pixels: float, device, maps) -> tuple[np.ndarray, np.ndarray]:
    import pyopencl as cl

    from pagas_cl.runtime.program import bind, build, run_once
    from pagas_cl.runtime.transfer import download, upload

    sample = depth[::8, ::8]
    if (sample > 0).any():
        scene_scale = float(np.median(sample[sample > 0]))
    else:
        scene_scale = float(np.max(depth, initial=0.0)) or 1.0
    table = camera_table(target, [camera for camera, _ in used], scene_scale)
    cameras, n = upload(device, table), depth.size
    parallax, found = (device.memory.buffer(device.context, 4 * n) for _ in range(2))
    cl.enqueue_fill_buffer(device.queue, found, np.uint32(0), 0, 4 * n)
    program, own = build(device, "agree.cl"), maps.map(depth)
    size, scale = (target.width, target.height), 1 / scene_scale
    run_once(device.queue, [bind(program, "parallax", size, None, own, cameras, len(used), scale, parallax)])
    for view, (_, other) in enumerate(used, start=1):
        run_once(device.queue, [bind(program, "count_view", size, None, own, cameras, view, scale, maps.map(other),
                                     parallax, float(pixels), found)])
    out = download(device, found, (*depth.shape, 2), np.uint16)
    return out[..., 0], out[..., 1]


def confirmations(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray | None],
                  pixels: float = 2.0, device=None) -> np.ndarray:
    """The first of `counts`: how many other views confirm each depth."""
    return counts(target, depth, cameras, depths, pixels, device)[0]


def confirmed(cameras: list[Camera], depths: Sequence[np.ndarray | Path | None], settings: Fusion,
              neighbours: list | None = None, device=None) -> list[np.ndarray | Path | None]:
    """Copies of the depth maps without the depths that fewer than `settings.agree_views` others confirm.

    Parameters
    ----------
    depths : list of ndarray of shape (H, W), or None; where nobody is asked also of paths, which stay what they are
    neighbours : list of sequences of int, optional
        For each view the others to ask (its context views); all others where it is left out.
    device : Device, optional
        As in `counts`.
    """
    if settings.agree_views == 0:
        return list(depths)
    kept, maps = [], None if device is None else DepthMaps(device)
    for i, (camera, depth) in enumerate(zip(cameras, depths)):
        asked = [j for j in (range(len(cameras)) if neighbours is None else neighbours[i]) if j != i]
        if depth is None:
            kept.append(None)
            continue
        count = counts(camera, depth, [cameras[j] for j in asked], [depths[j] for j in asked], settings.agree_pixels,
                       device, maps)[0]
        kept.append(np.where(count >= settings.agree_views, depth, np.float32(0)))
    return kept
