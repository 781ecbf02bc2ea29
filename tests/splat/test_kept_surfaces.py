"""Z-buffers that context views keep for some steps, and sums that are empty before each view."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from support.kernel_cases import Scene, start_level

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat.constants import MOST_MOVED
from pagas_cl.method.splat.options import SCALAR

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.make(9, width=45, height=37, contexts=3)


def made_at(device, config, scene, steps: int) -> list[int]:
    """The steps before which a z-buffer was made."""
    level, found, launches = start_level(device, config, scene), [], []
    plain = level.step_launches

    def noted(number):
        launches[:] = plain(number)
        if any(launch.stage == "nearest" for launch in launches):
            found.append(number)
        return launches

    level.step_launches = noted
    assert level.run(steps) == steps
    level.release()
    return found


def test_they_are_made_anew_once_depths_may_have_moved(device, scene):
    """The rate is constant over the first half: a step of 0.06, three views in turn, so at every ninth step."""
    config = BALANCED.with_settings(solver__rate=0.06)
    assert 6 * 0.06 < MOST_MOVED < 9 * 0.06
    assert made_at(device, config, scene, 40)[:6] == [0, 1, 2, 9, 10, 11]


@pytest.mark.parametrize("settings", [
    dict(solver__rate=0.2), dict(solver__rate_unit="distance", solver__rate=1e-3)], ids=["far", "distance"])
def test_they_are_made_at_every_turn(device, scene, settings):
    """Where three steps may go further than that, and where nobody knows."""
    assert made_at(device, BALANCED.with_settings(**settings), scene, 12) == list(range(12))


def test_none_is_kept_without_occlusion(device, scene):
    assert made_at(device, BALANCED.with_settings(splatting__occlusion=False), scene, 6) == []


def test_another_radius_makes_them_anew(device, scene):
    config = BALANCED.with_settings(splatting__final_radius=0.9, solver__rate=0.02)
    assert made_at(device, config, scene, 12) == [0, 1, 2, 6, 7, 8]
    same = config.with_settings(splatting__final_radius=1.42)
    assert made_at(device, same, scene, 12) == [0, 1, 2]


@pytest.mark.parametrize("pixels", ["vectors", "one pixel, as on a GPU"])
def test_a_view_finds_nothing_of_the_one_before(device, monkeypatch, scene, pixels):
    """The same view again gives the same gradient: what is splatted is added to an empty image."""
    if pixels != "vectors":
        monkeypatch.setattr("pagas_cl.runtime.device.Device.columns", lambda device, width: 1)
        monkeypatch.setattr("pagas_cl.method.splat.options.choose_tiles", lambda device, sizes: SCALAR)
    level, found = start_level(device, BALANCED, scene), []
    for number in (0, 1, 3):
        cl.enqueue_fill_buffer(device.queue, level.buffers.gradient, np.uint32(0), 0, level.buffers.gradient.size)
        for launch in level.step_launches(number):
            launch.enqueue(device.queue)
        found.append(level.gradient())
    level.release()
    assert (found[0] == found[2]).all() and (found[0] != found[1]).any()
