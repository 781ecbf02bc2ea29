"""The device gives the same relative depth in any unit of length and at any place (method section 2): every pixel
within 1e-5, also where the initial depth is float32, whose rounding (6e-8) differs between millimetres and metres, and
where it is rendered from a mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene
from support.synthetic.layout import half_sizes
from support.synthetic.mesh import solid_mesh

from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.refine import initial_depths
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.view import View

pytestmark = [pytest.mark.kernels, pytest.mark.slow]


@pytest.fixture(scope="module")
def made(device):
    return relief_scene(96, 72, 4)


@pytest.fixture(scope="module")
def plain(made):
    return refined(made, 1.0, (0, 0, 0))


def moved(view, scale, offset) -> View:
    """The view with its camera in another unit, at another place."""
    pose = view.camera.world_to_camera.copy()
    pose[:3, 3] = -pose[:3, :3] @ (view.camera.center * scale + np.asarray(offset, np.float64))
    return View(replace(view.camera, world_to_camera=pose), view.load_image(), view.load_mask())


def refined(made, scale, offset, dtype=np.float64):
    """The result with all settings at their defaults, its depth in units of the scale."""
    truth = made.true_depth(made.views[0].camera).astype(np.float64)
    bumps = np.kron(np.random.default_rng(0).standard_normal((9, 12)), np.ones((8, 8)))
    views = [moved(view, scale, offset) for view in made.views]
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
    assert (result.status == plain[0].status).mean() > 0.999          # a decision may sit on its threshold
    both = (result.status == 1) & (plain[0].status == 1)
    assert_alike(depth[both], plain[1][both])


@pytest.mark.parametrize("scale, offset", [(1e-3, (0, 0, 0)), (1e3, (0, 0, 0)), (1.0, (5e6, -5e6, 5e6))])
def test_depths_rendered_from_a_mesh(made, from_mesh, scale, offset):
    """What refine_mesh does before it fuses; Open3D renders float32."""
    here, there = from_mesh, refined_from_mesh(made, scale, offset)
    assert (here.status == there.status).mean() > 0.999
    both = (here.status == 1) & (there.status == 1)
    assert both.mean() > 0.3
    if scale == 1:
        assert there.depth[both].tobytes() == here.depth[both].tobytes(), "the place goes before anything is rounded"
    assert_alike(there.depth[both].astype(np.float64) / scale, here.depth[both])


def assert_alike(depth, other):
    assert np.abs(depth / other - 1).max() < 1e-5


@pytest.fixture(scope="module")
def from_mesh(made):
    pytest.importorskip("open3d")
    return refined_from_mesh(made, 1.0, (0, 0, 0))


def refined_from_mesh(made, scale, offset):
    vertices, faces = solid_mesh(made.initial_solid, 2 * made.relief.footprint, half_sizes(made.relief))
    views = [moved(view, scale, offset) for view in made.views]
    depths = initial_depths(Surface(vertices * scale + np.asarray(offset, np.float64), faces), views)
    return refine_depth(views[0], views[1:], depths[0])
