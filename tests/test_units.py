"""Depths to the device's units and back, whatever comes in."""

from types import SimpleNamespace

import numpy as np
import pytest

from pagas_cl.reference import units as twin
from pagas_cl.runtime.transfer import download, upload
from pagas_cl.scene.unit import FAR, MEDIAN_SAMPLES, NEAR, unit_of
from pagas_cl.splat.units import Entered

SPECIAL = np.array([0, -0.0, 1, -1, np.nan, np.inf, -np.inf, 1e-45, 1e-38, 3e38], np.float32)


def enter(device, depth, mask=None):
    """Depth in units as the device holds it, and what it was entered as."""
    entered = Entered(SimpleNamespace(load_mask=lambda: mask), depth, device)
    return download(device, entered.buffer, depth.shape), entered


def leave(device, entered, refined, parallax, deviation, status):
    buffers = [upload(device, a) for a in (refined, parallax, status, deviation)]
    return entered.leave(*buffers, refined.shape)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
def test_normalized_by_the_median_in_rows(device, dtype):
    rng = np.random.default_rng(1)
    depth = (rng.random((40, 30)) * 100 + 500).astype(dtype)
    depth[rng.random(depth.shape) < 0.3] = 0
    for given in (depth, np.asfortranarray(depth)):
        scaled, entered = enter(device, given)
        want, unit = twin.normalized_depth(given, None)
        assert entered.unit == unit == np.median(depth[depth > 0])
        assert np.allclose(scaled * unit, depth, rtol=1e-6) and np.array_equal(scaled, want)
        assert entered.spread == twin.depth_range(want) > 0.1


def test_what_a_float64_says_is_rounded_once(device):
    depth = np.random.default_rng(4).uniform(500, 600, (30, 40))
    scaled, entered = enter(device, depth)
    assert np.array_equal(scaled, (depth / entered.unit).astype(np.float32))
    assert not np.array_equal(scaled, enter(device, depth.astype(np.float32))[0])


def test_what_has_no_gaussian_is_zero(device):
    depth = np.full((6, 6), 2.0, np.float32)
    depth[0] = SPECIAL[[0, 1, 3, 4, 5, 6]]
    depth[1, :2] = 2 * NEAR / 1.1, 2 * FAR * 1.1
    mask = np.ones((6, 6), bool)
    mask[5] = False
    scaled, entered = enter(device, depth, mask)
    assert entered.unit == 2 and not scaled[0].any() and not scaled[1, :2].any() and not scaled[5].any()
    assert (scaled[2:5] == 1).all() and np.isfinite(scaled).all() and entered.spread == 0
    assert np.array_equal(scaled, twin.normalized_depth(depth, mask)[0])
    empty, entered = enter(device, np.zeros((3, 3)))
    assert entered.unit == 1 and entered.spread == 0 and not empty.any()
    assert enter(device, np.array([[0, 1.5, 4, 1.5]], np.float32))[1].spread == pytest.approx(2.5 / 1.5)


def test_a_small_object_in_a_large_photo_has_the_median_of_its_own():
    depth = np.zeros((1024, 1024), np.float32)
    depth[501:510, 333:350] = np.arange(1, 154, dtype=np.float32).reshape(9, 17)
    assert depth.size > 8 * MEDIAN_SAMPLES and unit_of(depth, None) == 77
    assert unit_of(depth, depth > 100) == 127


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_was_not_refined_comes_back_with_its_bits(device, dtype):
    rng = np.random.default_rng(2)
    given = np.concatenate([rng.random(50).astype(np.float32) * 7, SPECIAL]).reshape(6, 10).astype(dtype)
    status = rng.integers(0, 4, given.shape).astype(np.uint8)
    refined, parallax, deviation = (rng.random(given.shape).astype(np.float32) for _ in range(3))
    _, entered = enter(device, given)
    back = leave(device, entered, refined, parallax, deviation, status)
    for got, want in zip(back, twin.in_scene_units(refined, parallax, deviation, status, entered.unit, given)):
        assert got.dtype == want.dtype and np.array_equal(got, want)
    kept = np.where((given > 0) & np.isfinite(given), given, 0).astype(np.float32)
    assert np.array_equal(back[0][status != 1].view(np.uint32), kept[status != 1].view(np.uint32))
    assert (back[3][(status == 0) & (kept > 0)] == 2).all()
    _, entered = enter(device, np.full(status.shape, 1e300))           # too large for float32: no surface
    assert not leave(device, entered, refined, parallax, deviation, np.zeros_like(status))[0].any()
