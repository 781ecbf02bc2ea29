"""Levels: exact area averages down, interpolation up, validity."""

import numpy as np
import pytest

from pagas_cl.scene.depthmap import depth_down, depth_up


def brute(values, width, height):
    """Area average by definition."""
    rows, columns = values.shape[:2]
    out = np.zeros((height, width) + values.shape[2:])
    for i in range(height):
        for j in range(width):
            y0, y1, x0, x1 = (i * rows / height, (i + 1) * rows / height, j * columns / width,
                              (j + 1) * columns / width)
            wy = np.clip(np.minimum(np.arange(rows) + 1, y1) - np.maximum(np.arange(rows), y0), 0, None)
            wx = np.clip(np.minimum(np.arange(columns) + 1, x1) - np.maximum(np.arange(columns), x0), 0, None)
            weight = wy[:, None] * wx[None]
            out[i, j] = np.tensordot(weight, values, ([0, 1], [0, 1])) / weight.sum()
    return out


@pytest.mark.parametrize("size", [(10, 8), (7, 5)])
def test_depth_down_averages_the_valid(size):
    rng = np.random.default_rng(3)
    depth = np.where(rng.random((16, 20)) > 0.4, rng.uniform(1, 2, (16, 20)), 0).astype(np.float32)
    weight = brute(depth > 0, *size)
    with np.errstate(invalid="ignore"):
        want = np.where(weight > 1e-12, brute(depth.astype(float), *size) / weight, 0)
    assert np.allclose(depth_down(depth, *size), want, rtol=1e-6)


def test_depth_up_is_exact_on_ramps_and_never_mixes_with_nothing():
    y, x = np.mgrid[:6, :8]
    ramp = (10 + x + 2 * y).astype(np.float32)
    fine = depth_up(ramp, 16, 12)
    ys, xs = np.mgrid[:12, :16]
    want = 10 + np.clip((xs + 0.5) / 2 - 0.5, 0, 7) + 2 * np.clip((ys + 0.5) / 2 - 0.5, 0, 5)
    assert np.abs(fine - want).max() < 1e-5
    holes = np.where(x < 4, np.float32(5), np.float32(0))
    assert set(np.unique(depth_up(holes, 16, 12))) == {0, 5}
    assert (depth_up(holes, 16, 12)[:, :8] == 5).all()


def test_one_pixel():
    assert depth_up(np.full((1, 1), 3, np.float32), 4, 2).tolist() == [[3] * 4] * 2
    assert depth_down(np.full((2, 4), 3, np.float32), 1, 1) == 3
