"""Which depths other views confirm, and which they should see (method section 7); how far depth maps contradict
others."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.lib.stride_tricks import sliding_window_view

from pagas_cl.config import Fusion
from pagas_cl.errors import DeviceError, DeviceMemoryError, log
from pagas_cl.runtime.device import one_of, open_device, translate_cl_errors
from pagas_cl.runtime.memory import Held, download, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Camera, camera_table
from pagas_cl.scene.images import Loads
from pagas_cl.scene.inputs import check_maps, depth_array
from pagas_cl.scene.sampling import NEAR, evenly

_SAMPLED, _NEIGHBOURS = 6, 5      # views looked at, and neighbours of each
_EVERY = 4        # each so many-th row and column of theirs
_WINDOW = 4       # pixels to each side over which differences are averaged
OCCLUDED = 0.05   # share of the depth: a surface nearer by more hides what is behind it
_FRONT = 1e-6     # share of the target's depth: nearer to a camera's plane than this is behind it
_ROWS = 1 << 19   # pixels worked on at a time on the host, which bounds memory to some 100 MB


def counts(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray | None],
           pixels: float = 2.0, device=None, maps: Held | None = None) -> tuple[np.ndarray, np.ndarray]:
    """How many of the other views confirm each depth of `target`, and how many should see it. `depth` (H, W) is the
    target's, 0 = no surface; `cameras` and `depths` are the other views', None where one has no depth map. `pixels` is
    the tolerance, pixels of parallax. Compared on `device`, in NumPy without one; `maps` are depth maps that are there
    already. Two uint16 arrays (H, W), 0 where there is no surface; nothing confirms without parallax."""
    check_maps([target], [depth])
    check_maps(cameras, depths)
    have = [k for k, other in enumerate(depths) if other is not None]
    cameras, depths = [cameras[k] for k in have], [depths[k] for k in have]
    if device is not None:
        try:
            with translate_cl_errors(device, f"the comparison of view {target.name!r} with others"):
                return _on_device(target, depth, cameras, depths, pixels, device, maps)
        except DeviceMemoryError as error:
            log.warning("%s: its depths are compared on the host", str(error))
    return count_on_host(target, depth, cameras, depths, pixels)


def _on_device(target, depth, others, depths, pixels: float, device,
               maps: Held | None) -> tuple[np.ndarray, np.ndarray]:
    maps = maps or Held(device.memory.limit // 4)

    def on_device(one: np.ndarray) -> cl.Buffer:      # the array is held so that its id stays its own
        return maps.held(id(one), 4 * one.size, lambda: (one, upload(device, one.astype(np.float32, copy=False))))[1]

    sample = depth[::8, ::8]
    scene_scale = float(np.median(sample[sample > 0]) if (sample > 0).any() else np.max(depth, initial=0.0)) or 1.0
    cameras, n = upload(device, camera_table(target, others, scene_scale)), depth.size
    parallax, found = (device.buffer(4 * n) for _ in range(2))
    cl.enqueue_fill_buffer(device.queue, found, np.uint32(0), 0, 4 * n)
    program, own = build(device, "agree.cl", (f"NEAR={NEAR!r}f",)), on_device(depth)
    size, scale = (target.width, target.height), 1 / scene_scale
    given = {"depth": own, "cameras": cameras, "scale": scale, "depth_per_parallax": parallax}
    program.run("parallax", size, views=len(others), **given)
    for view, other in enumerate(depths, start=1):
        program.run("count_view", size, view=view, map=on_device(other), pixels=pixels, counts=found, **given)
    out = download(device, found, (*depth.shape, 2), np.uint16)
    return out[..., 0], out[..., 1]


def count_on_host(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray],
                  pixels: float) -> tuple[np.ndarray, np.ndarray]:
    """`counts` in NumPy, the twin of agree.cl: all others have a depth map of their camera's size."""
    others = [(camera, other, *camera.relative_to(target)) for camera, other in zip(cameras, depths)]
    counts = np.zeros((2, depth.size), np.uint16)
    valid = np.flatnonzero(depth.reshape(-1) > 0)
    for start in range(0, len(valid), _ROWS):
        chunk = valid[start:start + _ROWS]
        counts[:, chunk] = _count(target, depth.reshape(-1)[chunk].astype(np.float64), chunk, others, pixels)
    return tuple(counts.reshape(2, *depth.shape))


def _count(target: Camera, d: np.ndarray, pixel: np.ndarray, others: list, pixels: float) -> np.ndarray:
    rows, columns = np.divmod(pixel, target.width)
    rho = np.stack([(columns + 0.5 - target.cx) / target.fx, (rows + 0.5 - target.cy) / target.fy, np.ones(len(d))])
    squared, views, expected = np.zeros(len(d)), np.zeros(len(d)), np.zeros(len(d))
    errors = np.full((len(others), len(d)), np.inf)
    for error, (camera, depth, rotation, tau) in zip(errors, others):
        q = rotation @ rho
        u, v, z, inside = _landed(camera, q * d + tau[:, None], d)
        moved = ((camera.fx * (q[0] * tau[2] - q[2] * tau[0]) / z**2) ** 2
                 + (camera.fy * (q[1] * tau[2] - q[2] * tau[1]) / z**2) ** 2)
        squared += np.where(inside, moved, 0)
        views += inside
        error[inside] = difference(depth, u[inside], v[inside], z[inside])
        found = depth[v[inside].astype(np.intp), u[inside].astype(np.intp)]
        expected[inside] += (found > 0) & (z[inside] < found * (1 + OCCLUDED))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_per_parallax = np.sqrt(views / squared)  # one pixel of parallax, in depth; inf or NaN where there is none
    depth_per_parallax = np.where(np.isfinite(depth_per_parallax), depth_per_parallax, 0)
    return np.stack([np.count_nonzero((errors <= pixels * depth_per_parallax) & (depth_per_parallax > 0), axis=0),
                     expected])


def _landed(camera: Camera, places: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where a camera sees `places` (3, N) in its frame, of depths d in another view: u, v and depth, and whether it
    does."""
    x, y, z = places
    front = z > _FRONT * d
    z = np.where(front, z, 1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return u, v, z, front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def difference(depth: np.ndarray, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
    """|own depth - z|: the smaller of the pixel's own and, where all four neighbours are valid, their interpolation.
    Inverse depth is interpolated, since it is linear in the image on every plane. Infinite where there is no depth."""
    height, width = depth.shape
    near = depth[v.astype(np.intp), u.astype(np.intp)]
    best = np.where(near > 0, np.abs(near - z), np.inf)
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.intp), max(width - 2, 0)), np.minimum(y.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    inverse, valid = np.zeros(len(u)), np.ones(len(u), bool)
    for rows, columns, share in ((top, left, (1 - fy) * (1 - fx)), (top, right, (1 - fy) * fx),
                                 (bottom, left, fy * (1 - fx)), (bottom, right, fy * fx)):
        corner = depth[rows, columns].astype(np.float64)
        valid &= corner > 0
        inverse += share / np.where(corner > 0, corner, 1)
    return np.where(valid, np.minimum(best, np.abs(1 / np.where(valid, inverse, 1) - z)), best)


def confirmed(cameras: list[Camera], depths: Sequence[np.ndarray | Path], settings: Fusion,
              device=None) -> list[np.ndarray | Path]:
    """Copies of the depth maps (H, W) without the depths that fewer than `settings.agree_views` others confirm;
    unchanged, paths too, where that is 0. `device` as in `counts`."""
    if settings.agree_views == 0:
        return list(depths)
    maps = None if device is None else Held(device.memory.limit // 4)
    kept: list[np.ndarray | Path] = []
    for i, (camera, depth) in enumerate(zip(cameras, depths)):
        count = counts(camera, depth, cameras[:i] + cameras[i + 1:], [*depths[:i], *depths[i + 1:]],
                       settings.agree_pixels, device, maps)[0]
        kept.append(np.where(count >= settings.agree_views, depth, np.float32(0)))
    return kept


def comparison_device(name: Any) -> Any:
    """The device to compare depth maps on, the first of several that `name` means; None where there is none."""
    try:
        return open_device(one_of(name))
    except DeviceError:
        return None


def contradicted(cameras: list[Camera], depths, pixels: float, device=None) -> float:
    """Share of the depths which a neighbouring view should confirm, and none does: of a sample of views and pixels.
    `depths` are arrays (H, W), or have a load() or a .depth."""
    seen, refused = 0, 0
    for k in evenly(len(cameras), _SAMPLED):
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
    float64 of shape (H, W), averaged over windows of 9 x 9 pixels; NaN where no other view sees the surface."""
    total, count = np.zeros(depth.shape), np.zeros(depth.shape)
    rows, columns = np.nonzero(depth > 0)
    d, rho = depth[rows, columns].astype(np.float64), target.rays()[rows, columns].T
    for camera, other in zip(cameras, depths):
        rotation, tau = camera.relative_to(target)
        u, v, z, seen = _landed(camera, rotation @ (rho * d) + tau[:, None], d)
        inside = np.flatnonzero(seen)
        error = difference(other, u[inside], v[inside], z[inside]) / z[inside]
        same = error < OCCLUDED
        place = rows[inside[same]], columns[inside[same]]
        total[place] += error[same]
        count[place] += 1
    with np.errstate(invalid="ignore"):
        return _box(total) / np.where(_box(count) > 0.5, _box(count), np.nan)


def _box(values: np.ndarray) -> np.ndarray:
    """Sums over windows of 2 _WINDOW + 1 pixels."""
    values = np.pad(values, _WINDOW)
    for axis in (0, 1):
        values = sliding_window_view(values, 2 * _WINDOW + 1, axis).sum(-1)
    return values
