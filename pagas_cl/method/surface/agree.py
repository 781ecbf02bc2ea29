"""Which depths other views confirm (method section 7), on a device, or in NumPy where there is none; how much and how
far depth maps contradict each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import DeviceError, DeviceMemoryError, InputError, log
from pagas_cl.method.surface import agree_host as twin
from pagas_cl.scene.camera import Camera, camera_table
from pagas_cl.scene.images import Loads
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.sampling import NEAR

_SAMPLED, _NEIGHBOURS = 6, 5      # views looked at, and neighbours of each
_EVERY = 4        # each so many-th row and column of theirs
_WINDOW = 4       # pixels to each side over which differences are averaged


class DepthMaps:
    """Depth maps on the device, each uploaded once; the one unused for longest goes when a
    quarter of memory is taken."""

    def __init__(self, device):
        self.device, self.limit, self._held = device, device.memory.limit // 4, {}

    def map(self, depth: np.ndarray):
        """Buffer of float32 of `depth`."""
        from pagas_cl.runtime.memory import upload

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
    """How many of the other views confirm each depth of `target`, and how many should see it.

    `depth` (H, W) is the target's, 0 = no surface; `cameras` and `depths` are the other views', None where one has no
    depth map. `pixels` is the tolerance, pixels of parallax. Compared on `device`, in NumPy without one; `maps` are
    depth maps that are there already. Two uint16 arrays (H, W), 0 where there is no surface; nothing confirms without
    parallax.
    """
    if len(cameras) != len(depths):
        raise InputError(f"there are {len(cameras)} cameras and {len(depths)} depth maps, expected one each")
    for camera, other in [(target, depth), *zip(cameras, depths)]:
        if other is not None and other.shape != (camera.height, camera.width):
            raise InputError(f"depth map of {camera.name!r} is {other.shape[1]} x {other.shape[0]}, its camera says "
                             f"{camera.width} x {camera.height}")
    have = [k for k, other in enumerate(depths) if other is not None]
    cameras, depths = [cameras[k] for k in have], [depths[k] for k in have]
    if device is not None:
        from pagas_cl.runtime.device import translate_cl_errors

        try:
            with translate_cl_errors(device, f"the comparison of view {target.name!r} with others"):
                return _on_device(target, depth, cameras, depths, pixels, device, maps or DepthMaps(device))
        except DeviceMemoryError as error:
            log.warning("%s: its depths are compared on the host", str(error))
    return twin.count(target, depth, cameras, depths, pixels)


def _on_device(target, depth, others, depths, pixels: float, device, maps) -> tuple[np.ndarray, np.ndarray]:
    import pyopencl as cl

    from pagas_cl.runtime.memory import download, upload
    from pagas_cl.runtime.program import bind, build, run_once

    sample = depth[::8, ::8]
    scene_scale = float(np.median(sample[sample > 0]) if (sample > 0).any() else np.max(depth, initial=0.0)) or 1.0
    cameras, n = upload(device, camera_table(target, others, scene_scale)), depth.size
    parallax, found = (device.memory.buffer(device.context, 4 * n) for _ in range(2))
    cl.enqueue_fill_buffer(device.queue, found, np.uint32(0), 0, 4 * n)
    program, own = build(device, "agree.cl", (f"NEAR={NEAR!r}f",)), maps.map(depth)
    size, scale = (target.width, target.height), 1 / scene_scale
    given = {"depth": own, "cameras": cameras, "scale": scale, "depth_per_parallax": parallax}
    run_once(device.queue, [bind(program, "parallax", size, views=len(others), **given)])
    for view, other in enumerate(depths, start=1):
        run_once(device.queue, [bind(program, "count_view", size, view=view, map=maps.map(other), pixels=pixels,
                                     counts=found, **given)])
    out = download(device, found, (*depth.shape, 2), np.uint16)
    return out[..., 0], out[..., 1]


def confirmed(cameras: list[Camera], depths: Sequence[np.ndarray | Path | None], settings: Fusion,
              device=None) -> list[np.ndarray | Path | None]:
    """Copies of the depth maps (H, W) without the depths that fewer than `settings.agree_views` others confirm;
    unchanged, paths too, where that is 0. `device` as in `counts`."""
    if settings.agree_views == 0:
        return list(depths)
    maps = None if device is None else DepthMaps(device)
    kept: list[np.ndarray | Path | None] = []
    for i, (camera, depth) in enumerate(zip(cameras, depths)):
        if depth is None:
            kept.append(None)
            continue
        count = counts(camera, depth, cameras[:i] + cameras[i + 1:], [*depths[:i], *depths[i + 1:]],
                       settings.agree_pixels, device, maps)[0]
        kept.append(np.where(count >= settings.agree_views, depth, np.float32(0)))
    return kept


def comparison_device(name: Any) -> Any:
    """The device to compare depth maps on: that which `name` means (refine_mesh's `device`), the first of several; None
    where there is none."""
    from pagas_cl.runtime.device import one_of, open_device

    try:
        return open_device(one_of(name))
    except DeviceError:
        return None


def contradicted(cameras: list[Camera], depths, pixels: float, device=None) -> float:
    """Share of the depths which a neighbouring view should confirm, and none does: of a sample of views and pixels.
    `depths` are arrays (H, W), or have a load() or a .depth."""
    seen, refused = 0, 0
    for k in np.unique(np.linspace(0, len(cameras) - 1, _SAMPLED).astype(int)):
        depth, place = _array(depths[k]), np.s_[_EVERY // 2::_EVERY, _EVERY // 2::_EVERY]
        sample = np.zeros_like(depth)
        sample[place] = depth[place]
        away = [float(np.linalg.norm(camera.center - cameras[k].center)) for camera in cameras]
        nearest = [j for j in np.argsort(away, kind="stable") if j != k][:_NEIGHBOURS]
        near, maps = [cameras[j] for j in nearest], [_array(depths[j]) for j in nearest]
        confirmed_by, expected = counts(cameras[k], sample, near, maps, pixels, device)
        seen += int((expected > 0).sum())
        refused += int(((expected > 0) & (confirmed_by == 0)).sum())
    return refused / seen if seen else 0.0


def _array(depth) -> np.ndarray:
    return depth_array(depth if isinstance(depth, (np.ndarray, Loads)) else depth.depth)


def disagreement(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray]) -> np.ndarray:
    """Mean difference between a depth map and those of other views that see the same surface, as a share of depth.

    float64 of shape (H, W), averaged over windows of 9 x 9 pixels; NaN where no other view sees the surface.
    """
    total, count = np.zeros(depth.shape), np.zeros(depth.shape)
    rows, columns = np.nonzero(depth > 0)
    d, rho = depth[rows, columns].astype(np.float64), target.rays()[rows, columns].T
    for camera, other in zip(cameras, depths):
        rotation, tau = camera.relative_to(target)
        x, y, z = rotation @ (rho * d) + tau[:, None]
        front = z > 1e-6 * d
        z = np.where(front, z, 1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = np.flatnonzero(front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
        error = twin.difference(other, u[inside], v[inside], z[inside]) / z[inside]
        same = error < twin.OCCLUDED
        place = rows[inside[same]], columns[inside[same]]
        total[place] += error[same]
        count[place] += 1
    with np.errstate(invalid="ignore"):
        return _box(total) / np.where(_box(count) > 0.5, _box(count), np.nan)


def _box(values: np.ndarray) -> np.ndarray:
    """Sums over windows of 2 _WINDOW + 1 pixels."""
    for axis in (0, 1):
        padded = np.pad(values, [(_WINDOW + 1, _WINDOW) if a == axis else (0, 0) for a in (0, 1)])
        sums = np.moveaxis(np.cumsum(padded, axis=axis), axis, 0)
        values = np.moveaxis(sums[2 * _WINDOW + 1:] - sums[:-2 * _WINDOW - 1], 0, axis)
    return values
