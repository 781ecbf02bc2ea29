"""Levels of photos, masks and depth maps: area averages down, linear interpolation up.

Convention: an image is resampled such that its corners stay in place (`Camera.resized`), so that output pixel j covers
input from j n_in / n_out to (j + 1) n_in / n_out. Any ratio is allowed, not only 2.
"""

import numpy as np

from pagas_cl.scene.view import View

_WHOLE = 1.0 - 1e-6  # a cell counts as wholly covered above this share (partial pixels leave rounding)


def level_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Width and height at `scale`, whole pixels, at least 1."""
    return max(1, round(width * scale)), max(1, round(height * scale))


def view_at(view: View, scale: float) -> View:
    """The view at `scale`, photo and mask loaded and area-averaged (the same view at scale 1, files left unread)."""
    width, height = level_size(view.camera.width, view.camera.height, scale)
    if (width, height) == (view.camera.width, view.camera.height):
        return view
    mask = view.load_mask()
    return View(view.camera.resized(width, height), photo_to(view.load_image(), width, height),
                None if mask is None else mask_to(mask, width, height), view.name)


def photo_to(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of a photo (H, W, 3) uint8, rounded to 8 bit; where a side grows, that side is interpolated."""
    same = photo.shape[:2] == (height, width)
    return photo if same else np.rint(_resampled(photo, width, height)).astype(np.uint8)


def mask_to(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mask (H, W) bool at another size: true where everything that the pixel covers is true."""
    return mask if mask.shape == (height, width) else _resampled(mask, width, height) > _WHOLE


def depth_down(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth (H, W) at a coarser size: mean of the valid (> 0) among the covered pixels, 0 where there is none."""
    if depth.shape == (height, width):
        return depth
    valid = depth > 0
    weight = _resampled(valid, width, height)
    total = _resampled(np.where(valid, depth, 0), width, height)
    some = weight > 1e-9
    return np.where(some, total / np.where(some, weight, 1), 0).astype(np.float32)


def depth_up(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth (H, W) at a finer size: bilinear at pixel centres over the valid (> 0) neighbours, 0 where there is none.

    Validity grows by up to a pixel of the coarse level: one valid neighbour is enough.
    """
    if depth.shape == (height, width):
        return depth
    (top, bottom, fy), (left, right, fx) = _taps(depth.shape[0], height), _taps(depth.shape[1], width)
    total, weight = np.zeros((height, width)), np.zeros((height, width))
    for rows, wy in ((top, 1 - fy), (bottom, fy)):
        for columns, wx in ((left, 1 - fx), (right, fx)):
            corner = depth[rows[:, None], columns[None, :]]
            share = np.where(corner > 0, wy[:, None] * wx[None, :], 0)
            total += share * np.where(corner > 0, corner, 0)
            weight += share
    some = weight > 1e-9
    return np.where(some, total / np.where(some, weight, 1), 0).astype(np.float32)


def _taps(n_in: int, n_out: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper neighbour of every output pixel centre, and the share of the upper one."""
    x = np.clip((np.arange(n_out) + 0.5) * n_in / n_out - 0.5, 0, n_in - 1)
    low = np.minimum(np.floor(x).astype(np.intp), max(n_in - 2, 0))
    return low, np.minimum(low + 1, n_in - 1), x - low


def _resampled(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average over the first two axes, float64."""
    return _along(_along(values, height, 0), width, 1)


def _along(values: np.ndarray, n_out: int, axis: int) -> np.ndarray:
    n_in = values.shape[axis]
    if n_out == n_in:
        return values.astype(np.float64)
    values = np.moveaxis(values, axis, 0)
    if n_in % n_out == 0:
        step = n_in // n_out
        result = sum(values[k::step].astype(np.float64) for k in range(step)) / step
    elif n_out > n_in:
        low, high, share = _taps(n_in, n_out)
        share = share.reshape(-1, *[1] * (values.ndim - 1))
        result = values[low] * (1 - share) + values[high] * share
    else:
        # the integral of the piecewise constant signal at the cells' borders; its differences are the cells' sums
        integral = np.zeros((n_in + 1, *values.shape[1:]))
        np.cumsum(values, axis=0, dtype=np.float64, out=integral[1:])
        border = np.arange(n_out + 1) * (n_in / n_out)
        low = np.minimum(border.astype(np.intp), n_in - 1)
        share = (border - low).reshape(-1, *[1] * (values.ndim - 1))
        at = integral[low] * (1 - share) + integral[low + 1] * share
        result = np.diff(at, axis=0) * (n_out / n_in)
    return np.moveaxis(result, 0, axis)
