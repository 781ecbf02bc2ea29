"""Depths to the device's units and back, whatever comes in."""

from types import SimpleNamespace

import numpy as np
import pytest
from twins import units as twin
from twins.project import normalized_depth

from pagas_cl.method.splat.units import NormalizedDepth, room_for
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.sampling import FAR, MEDIAN_SAMPLES, NEAR, scene_scale_of

pytestmark = pytest.mark.kernels

SPECIAL = np.array([0, -0.0, 1, -1, np.nan, np.inf, -np.inf, 1e-45, 1e-38, 3e38], np.float32)


def normalize(device, depth, mask=None):
    """Depth in units as the device holds it, and what it was normalized as."""
    normalized = NormalizedDepth(SimpleNamespace(load_mask=lambda: mask), depth, device)
    return download(device, normalized.buffer, depth.shape), normalized


def denormalize(device, normalized, refined, parallax, deviation, status):
    buffers = [upload(device, a) for a in (refined, parallax, status, deviation)]
    return normalized.denormalize(*buffers, room_for(refined.shape).result())


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
def test_normalized_by_the_median_in_rows(device, dtype):
    rng = np.random.default_rng(1)
    depth = (rng.random((40, 30)) * 100 + 500).astype(dtype)
    depth[rng.random(depth.shape) < 0.3] = 0
    for given in (depth, np.asfortranarray(depth)):
        scaled, normalized = normalize(device, given)
        want, scene_scale = normalized_depth(given, None)
        assert normalized.scene_scale == scene_scale == np.median(depth[depth > 0])
        assert np.allclose(scaled * scene_scale, depth, rtol=1e-6) and np.array_equal(scaled, want)
        assert normalized.depth_range == twin.depth_range(want) > 0.1


def test_what_a_float64_says_is_rounded_once(device):
    depth = np.random.default_rng(4).uniform(500, 600, (30, 40))
    scaled, normalized = normalize(device, depth)
    assert np.array_equal(scaled, (depth / normalized.scene_scale).astype(np.float32))
    assert not np.array_equal(scaled, normalize(device, depth.astype(np.float32))[0])


def test_what_has_no_gaussian_is_zero(device):
    depth = np.full((6, 6), 2.0, np.float32)
    depth[0] = SPECIAL[[0, 1, 3, 4, 5, 6]]
    depth[1, :2] = 2 * NEAR / 1.1, 2 * FAR * 1.1
    mask = np.ones((6, 6), bool)
    mask[5] = False
    scaled, normalized = normalize(device, depth, mask)
    assert normalized.scene_scale == 2 and not scaled[0].any() and not scaled[1, :2].any() and not scaled[5].any()
    assert (scaled[2:5] == 1).all() and np.isfinite(scaled).all() and normalized.depth_range == 0
    assert np.array_equal(scaled, normalized_depth(depth, mask)[0])
    empty, normalized = normalize(device, np.zeros((3, 3)))
    assert normalized.scene_scale == 1 and normalized.depth_range == 0 and not empty.any()
    assert normalize(device, np.array([[0, 1.5, 4, 1.5]], np.float32))[1].depth_range == pytest.approx(2.5 / 1.5)


def test_a_small_object_in_a_large_photo_has_the_median_of_its_own():
    depth = np.zeros((1024, 1024), np.float32)
    depth[501:510, 333:350] = np.arange(1, 154, dtype=np.float32).reshape(9, 17)
    assert depth.size > 8 * MEDIAN_SAMPLES and scene_scale_of(depth, None) == 77
    assert scene_scale_of(depth, depth > 100) == 127


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_was_not_refined_comes_back_with_its_bits(device, dtype):
    rng = np.random.default_rng(2)
    given = np.concatenate([rng.random(50).astype(np.float32) * 7, SPECIAL]).reshape(6, 10).astype(dtype)
    status = rng.integers(0, 4, given.shape).astype(np.uint8)
    refined, parallax, deviation = (rng.random(given.shape).astype(np.float32) for _ in range(3))
    _, normalized = normalize(device, given)
    back = denormalize(device, normalized, refined, parallax, deviation, status)
    for got, want in zip(back, twin.in_scene_units(refined, parallax, deviation, status, normalized.scene_scale,
                                                   given)):
        assert got.dtype == want.dtype and np.array_equal(got, want)
    kept = np.where((given > 0) & np.isfinite(given), given, 0).astype(np.float32)
    assert np.array_equal(back[0][status != 1].view(np.uint32), kept[status != 1].view(np.uint32))
    assert (back[3][(status == 0) & (kept > 0)] == 2).all()
    _, normalized = normalize(device, np.full(status.shape, 1e300))           # too large for float32: no surface
    assert not denormalize(device, normalized, refined, parallax, deviation, np.zeros_like(status))[0].any()
