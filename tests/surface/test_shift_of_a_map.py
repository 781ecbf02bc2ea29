"""The shift of a single depth map shows in photos where depths differ enough: a plane that leads away from cameras."""

from dataclasses import replace

import numpy as np
import pytest

from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.view import View

_CAMERA = Camera(200, 150, 180, 180, 100, 75, np.eye(4))


def plane(camera: Camera) -> np.ndarray:
    """Depth (H, W) of z = 6 + 0.8 y + 0.5 x, metres; cameras look along z."""
    x, y, _ = np.moveaxis(camera.rays_at(*np.indices((camera.height, camera.width))), -1, 0)
    depth: np.ndarray = (6 + 0.5 * camera.center[0]) / (1 - 0.8 * y - 0.5 * x)
    return depth.astype(np.float32)


def seen(name: str, right: float) -> View:
    pose = np.eye(4)
    pose[0, 3] = -right
    camera = replace(_CAMERA, world_to_camera=pose, name=name)
    points = camera.rays_at(*np.indices((150, 200))) * plane(camera)[..., None] + camera.center
    waves = np.random.default_rng(5).uniform(40, 215, (400, 400)).astype(np.float32)
    grey = bilinear(waves, 200 + 12 * points[..., 0] + 3 * points[..., 2], 200 + 12 * points[..., 1])
    return View(camera, np.repeat(grey.round().astype(np.uint8)[..., None], 3, axis=2))


@pytest.fixture(scope="module")
def views():
    return [seen("left", 0.0), seen("right", 0.4)]


@pytest.mark.parametrize("factor, shift", [(1.1, 0.05), (0.9, -0.04)])
def test_a_shift_is_found(views, factor, shift):
    truth = plane(views[0].camera)
    given = (factor * truth + shift * np.median(truth)).astype(np.float32)
    found = align_depth_scales(views, [given, None])
    off = np.abs(found.apply([given, None])[0] - truth) * 180 * 0.4 / truth**2
    assert "is added" in found.said[0] and off.mean() < 0.1      # pixels; 0.2 to 0.6 with the factor alone


def test_a_factor_gets_no_shift(views):
    truth = plane(views[0].camera)
    found = align_depth_scales(views, [np.float32(1.08) * truth, None])
    assert found.factors[0] * 1.08 == pytest.approx(1, abs=5e-3) and abs(found.shifts[0]) < 0.01 * np.median(truth)
