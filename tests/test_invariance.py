"""The device gives the same relative depth in any unit of length and at any place (method section 2).

The initial depth is given in float64 here. In float32 its own rounding differs between millimetres and metres by 6e-8,
which an L1 loss turns into a median of 4e-6 and, for one pixel in a hundred, up to a few hundredths of a pixel of
parallax: the second test holds that down.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pagas_cl.errors import DeviceError
from pagas_cl.made import relief_scene
from pagas_cl.refine import refine_depth
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.view import View


@pytest.fixture(scope="module")
def made():
    try:
        open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    return relief_scene(96, 72, 4)


@pytest.fixture(scope="module")
def plain(made):
    return refined(made, 1.0, (0, 0, 0))


def refined(made, scale, offset, dtype=np.float64):
    """The result with all settings at their defaults, its depth in units of the scale."""
    def view(v):
        pose = v.camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (v.camera.center * scale + np.asarray(offset, np.float64))
        return View(replace(v.camera, world_to_camera=pose), v.load_image(), v.load_mask())

    truth = made.true_depth(made.views[0].camera).astype(np.float64)
    bumps = np.kron(np.random.default_rng(0).standard_normal((9, 12)), np.ones((8, 8)))
    views = [view(v) for v in made.views]
    result = refine_depth(views[0], views[1:], (truth * (1 + 4e-3 * bumps) * scale).astype(dtype))
    assert (result.status == 1).mean() > 0.3
    return result, result.depth.astype(np.float64) / scale


@pytest.mark.parametrize("scale, offset", [(1e-3, (0, 0, 0)), (1e3, (0, 0, 0)), (1e-6, (0, 0, 0)), (1e6, (0, 0, 0)),
                                           (1.0, (5e6, -5e6, 5e6)), (1.0, (1e7, 0, -1e7))])
def test_units_and_place_change_nothing(made, plain, scale, offset):
    result, depth = refined(made, scale, offset)
    assert (result.status == plain[0].status).all()
    valid = plain[1] > 0
    assert (np.abs(depth - plain[1])[valid] / plain[1][valid]).max() < 1e-5


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_rounded_initial_depth_changes_little(made, plain, scale):
    result, depth = refined(made, scale, (0, 0, 0), np.float32)
    both = (result.status == 1) & (plain[0].status == 1)
    assert both.mean() > 0.9 * (plain[0].status == 1).mean()
    relative = np.abs(depth - plain[1])[both] / plain[1][both]
    assert np.median(relative) < 1e-5
    assert np.quantile(np.abs(depth - plain[1])[both] / plain[0].parallax[both], 0.99) < 0.03


def test_the_order_of_the_array_in_memory_changes_nothing(made):
    """A depth map by columns (a transposed array, some resized ones) is the same depth map."""
    depth = made.initial_depth(made.views[0].camera)
    rows, columns = (refine_depth(made.views[0], made.views[1:], order(depth)).depth
                     for order in (np.ascontiguousarray, np.asfortranarray))
    assert np.array_equal(rows, columns) and not np.array_equal(rows, depth)
