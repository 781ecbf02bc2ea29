"""The gradient averaged over neighbouring pixels: by hand, and the kernels against the twin."""

import numpy as np
import pytest
from support.kernel_cases import Scene, start_level
from twins.gradient_filter import filter_gradient
from twins.level import parts_of_loss, prepare

from pagas_cl.config.presets import preset
from pagas_cl.runtime.device import open_device

pytestmark = pytest.mark.kernels


def test_a_tent_by_hand():
    gradient = np.zeros((5, 6))
    gradient[2, 2] = 16.0
    tent = np.array([0, 1, 2, 1, 0]) / 4
    assert filter_gradient(gradient, np.ones_like(gradient), 1)[:, :5] == pytest.approx(16 * np.outer(tent, tent))
    assert filter_gradient(gradient, np.ones_like(gradient), 0) is gradient


def test_it_counts_in_pixels_of_parallax_and_leaves_fixed_pixels():
    """d / length is what is averaged, so that a pixel four times as far off in depth counts no more."""
    length = np.ones((1, 4))
    length[0, 2], length[0, 3] = 4.0, 0.0
    gradient = np.array([[0.0, 0.0, 1.0, 1.0]])
    across = np.array([[0.0, 1.0, 2.0 / 4, 0.0]]) * (2 / 4)  # rows alone: one row keeps half of it
    assert filter_gradient(gradient, length, 1) == pytest.approx(across)


def test_borders_take_nothing_from_the_other_side():
    gradient = np.zeros((4, 5))
    gradient[:, 0] = 1.0
    assert (filter_gradient(gradient, np.ones_like(gradient), 2)[:, 3:] == 0).all()


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_kernels_are_the_twin(radius):
    config = preset("balanced").with_settings(solver__gradient_filter=radius, smoothness__full_views=1)
    device, scene = open_device(None), Scene.make(3)
    level = start_level(device, config, scene)
    for launch in level.step_launches(0):
        launch.enqueue(device.queue)
    found = level.gradient().astype(np.float64)
    level.release()
    initial = scene.initial.astype(np.float64)
    state = prepare(initial, scene.target, scene.contexts, config, scene.scene_scale, scene.depth_threshold(config))
    photos, smooth = parts_of_loss(scene.moved.astype(np.float64), scene.target, scene.contexts, config, state, [0])
    wanted = filter_gradient(photos[1], state.parallax, radius) + smooth[1]
    assert np.linalg.norm(found - wanted) < 5e-4 * np.linalg.norm(wanted)
    assert np.linalg.norm(photos[1] + smooth[1] - wanted) > 0.1 * np.linalg.norm(wanted)
