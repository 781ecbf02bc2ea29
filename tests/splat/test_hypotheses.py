"""Depths along the ray where photos match badly, against float64 twins and against the truth."""

import numpy as np
import pyopencl as cl
import pytest
from support.scenes import relief_scene
from twins import hypotheses as twin
from twins.photo_loss import Photo

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.effects.decide import FAR_FOUND
from pagas_cl.method.splat import PhotoStore, ViewInput, better_start, hypotheses_for
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.depthmap import REFINED

pytestmark = pytest.mark.kernels

PIXELS = 8.0                                 # of parallax by which a part of the depth is off,
PLACE = np.s_[24:44, 36:60]                  # this one


@pytest.fixture(scope="module")
def scene():
    return relief_scene(96, 72, 4, held_out=0, steps=0, detail=0.1)


@pytest.fixture(scope="module")
def off(scene):
    """The true depth of the target, but for a part of it."""
    depth = scene.true_depth(scene.cameras[0])
    depth[PLACE] += np.float32(PIXELS * scene.relief.parallax)
    return depth


@pytest.fixture
def search(device, scene, off):
    target, *contexts = scene.views
    given = ViewInput(target, contexts, off, device, PhotoStore(device))
    with hypotheses_for(given, BALANCED) as found:
        yield found, given.normalized()
    given.normalized().release()


def test_planes_and_costs_match_their_twin(device, scene, off, search):
    hypotheses, normalized = search
    target, *contexts = [Photo.from_view(view) for view in scene.views]
    planes = twin.planes_of(off.astype(np.float64) / normalized.scene_scale)
    surface = download(device, hypotheses._known["surface"], planes.shape)
    np.testing.assert_allclose(surface, planes, atol=1e-6)
    places = np.flatnonzero(np.random.default_rng(0).random(off.size) < 0.02)
    known = hypotheses._known
    expected = [twin.better_half([twin.cost(surface.reshape(-1, 3)[place].astype(np.float64), (place % 96, place // 96),
                                            target, context, normalized.scene_scale, known["contrast"], known["noise"])
                                  for context in contexts]) for place in places]
    assert min(expected) < 0.1 and max(expected) > 0.8
    np.testing.assert_allclose(hypotheses._cost(places), expected, atol=2e-3)


def test_costs_nearby_are_the_least_of_planes_half_a_pixel_around_of_what_is_of_the_same_surface(device, scene, off,
                                                                                                  search):
    hypotheses, normalized = search
    target, *contexts = [Photo.from_view(view) for view in scene.views]
    surface = download(device, hypotheses._known["surface"], (off.size, 3)).astype(np.float64)
    places = np.flatnonzero(np.random.default_rng(1).random(off.size) < 0.01)
    known = hypotheses._known

    def cost(place, inverse, counts):
        return twin.better_half([twin.cost((inverse, *surface[place, 1:]), (place % 96, place // 96), target, context,
                                           normalized.scene_scale, known["contrast"], known["noise"], counts)
                                 for context in contexts])

    inverse = surface[places, 0]
    pixel = [1 / pixels_per_inverse(scene, *one, normalized) for one in zip(places, inverse)]
    planes = surface.reshape(*off.shape, 3)
    same = [twin.on_plane(planes, (place % 96, place // 96), twin.SAME * one) for place, one in zip(places, pixel)]
    expected = [min(cost(place, middle + shift * one, counts) for shift in (-0.5, -0.25, 0, 0.25, 0.5))
                for place, middle, one, counts in zip(places, inverse, pixel, same)]
    assert any(not counts[place // 96 - 3:place // 96 + 4, place % 96 - 3:place % 96 + 4].all()
               for place, counts in zip(places, same))
    costs = hypotheses.costs_nearby(upload(device, places.astype(np.int32)), len(places))
    np.testing.assert_allclose(download(device, costs, len(places)), expected, atol=4e-3)


def pixels_per_inverse(scene, place, inverse, normalized):
    """Pixels that a point at this place moves by in photos that see it, mean, where its inverse depth grows by 1."""
    target, *contexts = scene.cameras
    ray = np.array([(place % 96 + 0.5 - target.cx) / target.fx, (place // 96 + 0.5 - target.cy) / target.fy, 1.0])
    rotation, tau = target.world_to_camera[:3, :3], target.world_to_camera[:3, 3]
    found = []
    for camera in contexts:
        step = 1e-5 * inverse
        uv, z = camera.project([(ray * normalized.scene_scale / w - tau) @ rotation
                                for w in (inverse - step, inverse, inverse + step)])
        if camera.holds(uv[1], z[1]):
            found.append(np.linalg.norm(uv[2] - uv[0]) / (2 * step))
    return np.mean(found)


def test_the_start_that_photos_match_better_is_taken(device, scene, off):
    """Where one is off by eight pixels and the other by a third, on either side; where none is, nothing changes."""
    target, *contexts = scene.views
    true = scene.true_depth(target.camera)
    near = (true + 0.3 * scene.relief.parallax).astype(np.float32)

    def better(one, other):
        given = ViewInput(target, contexts, one, device, PhotoStore(device))
        return better_start(given, lambda depth: cl.enqueue_copy(device.queue, depth, other), BALANCED)

    moved = near.copy()
    moved[PLACE] += np.float32(PIXELS * scene.relief.parallax)
    for found in (better(near, moved), better(moved, near)):
        assert (found == near)[PLACE].mean() > 0.7
        assert np.isin(found, (near, moved)).all() and (found == near)[moved == near].all()
    np.testing.assert_array_equal(better(near, near), near)


def test_what_is_off_is_found_and_nothing_else_is_moved(scene, off, search):
    hypotheses, normalized = search
    true = scene.true_depth(scene.cameras[0])
    places, depths = hypotheses.search()
    found = np.zeros(off.shape)
    np.put(found, places, depths * normalized.scene_scale)
    inside, right = np.zeros(off.shape, bool), np.abs(found - true) < scene.relief.parallax
    inside[PLACE] = True
    assert right[inside].mean() > 0.7
    assert (found[~inside] > 0).mean() < 0.01
    assert not any(map(len, hypotheses.search(least=0.3)))


@pytest.mark.parametrize("choice, share", [("off", 0.2), ("auto", 0.8)])
def test_steps_go_on_from_what_was_found(device, scene, off, choice, share):
    target, *contexts = scene.views
    result = refine_depth(target, contexts, off, device=device,
                          config=BALANCED.with_settings(effects__hypotheses=choice, effects__pyramid="off"))
    true = scene.true_depth(target.camera)
    right = (np.abs(result.depth - true) < 0.3 * scene.relief.parallax)[PLACE].mean()
    assert right > share if choice == "auto" else right < share
    unmoved = result.status != REFINED
    np.testing.assert_array_equal(result.depth[unmoved], off[unmoved])


def test_a_right_depth_is_not_searched(device, scene):
    target, *contexts = scene.views
    result = refine_depth(target, contexts, scene.initial_depth(target.camera), device=device)
    decision, = (effect for effect in result.report["effects"] if effect["effect"] == "hypotheses")
    assert not decision["on"] and decision["evidence"] < FAR_FOUND / 2
