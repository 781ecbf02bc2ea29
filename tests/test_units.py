"""Depths to the device's units and back, whatever comes in."""

import numpy as np
import pytest

from pagas_cl.splat.units import FAR, MEDIAN_SAMPLES, NEAR, depth_range, normalized_depth, scene_depth

SPECIAL = np.array([0, -0.0, 1, -1, np.nan, np.inf, -np.inf, 1e-45, 1e-38, 3e38], np.float32)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
def test_normalized_by_the_median_in_rows(dtype):
    rng = np.random.default_rng(1)
    depth = (rng.random((40, 30)) * 100 + 500).astype(dtype)
    depth[rng.random(depth.shape) < 0.3] = 0
    for given_depth in (depth, np.asfortranarray(depth)):
        scaled, unit = normalized_depth(given_depth, None)
        assert unit == np.median(depth[depth > 0]) and scaled.dtype == np.float32 and scaled.flags.c_contiguous
        assert np.allclose(scaled * unit, depth, rtol=1e-6) and ((scaled == 0) == (depth == 0)).all()


def test_what_has_no_gaussian_is_zero():
    depth = np.full((6, 6), 2.0, np.float32)
    depth[0] = SPECIAL[[0, 1, 3, 4, 5, 6]]
    depth[1, :2] = 2 * NEAR / 1.1, 2 * FAR * 1.1
    mask = np.ones((6, 6), bool)
    mask[5] = False
    scaled, unit = normalized_depth(depth, mask)
    assert unit == 2 and not scaled[0].any() and not scaled[1, :2].any() and not scaled[5].any()
    assert (scaled[2:5] == 1).all() and np.isfinite(scaled).all()
    assert normalized_depth(np.zeros((3, 3)), None)[1] == 1
    assert depth_range(scaled) == 0 and depth_range(np.zeros((2, 2), np.float32)) == 0
    assert depth_range(np.array([[0, 1.5, 4]], np.float32)) == 2.5


def test_a_small_object_in_a_large_photo_has_the_median_of_its_own():
    depth = np.zeros((1024, 1024), np.float32)
    depth[501:510, 333:350] = np.arange(1, 154, dtype=np.float32).reshape(9, 17)
    assert depth.size > 8 * MEDIAN_SAMPLES and normalized_depth(depth, None)[1] == 77


def test_what_was_not_refined_comes_back_with_its_bits():
    rng = np.random.default_rng(2)
    given_depth = np.concatenate([rng.random(50).astype(np.float32) * 7, SPECIAL]).reshape(6, 10)
    status = rng.integers(0, 4, given_depth.shape).astype(np.uint8)
    refined = rng.random(given_depth.shape).astype(np.float32)
    back = scene_depth(refined.copy(), 3.3, status, given_depth)
    assert not scene_depth(refined.copy(), 3.3, np.zeros_like(status), np.full(status.shape, 1e300)).any()
    kept = np.where((given_depth > 0) & np.isfinite(given_depth), given_depth, 0)
    assert np.array_equal(back[status != 1], kept[status != 1])
    assert np.array_equal(back[status == 1], refined[status == 1] * np.float32(3.3))
