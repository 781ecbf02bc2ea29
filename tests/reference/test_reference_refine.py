"""The twins' losses, solver, pyramid and whole refinement against known answers."""

from __future__ import annotations

import numpy as np
import pytest
from support.close import closeness
from support.random_scenes import pose, random_image, random_scene, rotation
from support.reference_cases import BASE, prepared
from twins import loss as losses
from twins import resample, smooth
from twins.level import loss_and_gradient, prepare, refine
from twins.photo_loss import Photo
from twins.project import NEAR, project
from twins.smooth import normals
from twins.step import Adam, Plateau
from twins.units import median_depth

from pagas_cl.config import Config, Loss
from pagas_cl.scene.camera import Camera, focus, viewing_distance


def test_ssim_is_scikit_images():
    pytest.importorskip("scipy")
    metrics = pytest.importorskip("skimage.metrics")
    rng = np.random.default_rng(0)
    x, y = random_image(rng, 30, 21), random_image(rng, 30, 21)
    want = metrics.structural_similarity(x, y, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5,
                                         use_sample_covariance=False)
    assert losses.ssim(x, y)[0] == pytest.approx(want, rel=1e-9)
    assert losses.ssim(x, x)[0] == pytest.approx(1, abs=1e-12)


def test_ssim_without_a_window_is_no_term():
    x, y = np.zeros((10, 30, 3)), np.ones((10, 30, 3))
    value, gradient = losses.ssim(x, y)
    assert value == 1 and (gradient == 0).all() and gradient.shape == x.shape
    value, _, _ = losses.photometric(x, np.ones((10, 30)), y, Loss(ssim=0.5, huber=0.0))
    assert value == pytest.approx(0.5, rel=1e-12)


def test_blur_and_its_backward_are_adjoint():
    rng = np.random.default_rng(0)
    image, other = rng.random((17, 14, 2)), rng.random((7, 4, 2))
    assert (losses.blur(image) * other).sum() == pytest.approx((image * losses.blur_vjp(other)).sum(), rel=1e-12)
    assert losses.blur(np.ones((11, 12))) == pytest.approx(np.ones((1, 2)), rel=1e-14)


def test_w_grad_by_hand():
    image = np.zeros((2, 3, 3))
    image[:, 1] = 0.06  # the step is 0.06: (0.06 - 0.02) / 0.08
    image[1, 2] = (0.3, 0, 0)  # mean over channels of the larger difference
    want = np.array([[0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    want[0, 1] = 0.5  # across to (0, 2): 0.06 in each channel; down: 0
    want[0, 2] = (0.1 - 0.02) / 0.08  # down to (1, 2): 0.3 in one channel
    want[1, 1] = ((0.24 + 0.06 + 0.06) / 3 - 0.02) / 0.08
    assert losses.w_grad(image) == pytest.approx(np.clip(want, 0, 1), abs=1e-12)
    assert losses.comparable(np.full((1, 1, 3), 0.5), Loss(grey=True)) == pytest.approx(np.full((1, 1, 1), 0.5))


def test_masked_pixels_and_unseen_pixels_have_no_say():
    depth, target, contexts, state = prepared(3, BASE)
    photo = contexts[0].image
    rng = np.random.default_rng(0)
    mask = rng.random(photo.shape[:2]) > 0.3
    color, coverage = random_image(rng, photo.shape[1], photo.shape[0]), rng.random(photo.shape[:2])
    other = np.where(mask[..., None], color, 0.123)
    for kind in (dict(mask=mask), dict(seen_mask=mask)):
        loss = Loss(unseen_mask=True, ssim=0.2 if "mask" in kind else 0.0)
        a, v_color, v_coverage = losses.photometric(color, coverage, photo, loss, **kind)
        b, _, _ = losses.photometric(other, coverage, photo, loss, **kind)
        assert a == b and (v_color[~mask] == 0).all() and (v_coverage[~mask] == 0).all()
    projected = project(depth, target.camera, contexts[0].camera, 0.0, state.scene_scale)
    seen = losses.seen(projected, contexts[0].camera.width, contexts[0].camera.height)
    by_hand = np.zeros_like(seen)
    for (x, y), valid in zip(projected.m, projected.valid):
        if valid and 0 <= x < seen.shape[1] and 0 <= y < seen.shape[0]:
            by_hand[int(y), int(x)] = True
    assert (seen == by_hand).all() and seen.any() and not seen.all()


def test_smoothness_vanishes_on_planes():
    camera = Camera(12, 9, 15, 14, 6.5, 4, pose(np.eye(3), (0, 0, 0)))
    rays, valid = camera.rays(), np.ones((9, 12), bool)
    plane = 2 / (rays @ np.array([0.3, -0.2, 1.0]))
    value, gradient = smooth.planar(plane, valid, np.ones((9, 12)), np.ones((9, 12)), 1.0, 0.1)
    assert value < 1e-25 and np.abs(gradient).max() < 1e-12
    value, gradient = smooth.normal(plane, valid, rays, np.ones((9, 12)), 1.0)
    assert abs(value) < 1e-14 and np.abs(gradient).max() < 1e-12
    n = normals(plane, valid, rays)
    assert n[1:-1, 1:-1] == pytest.approx(np.broadcast_to(np.array([0.3, -0.2, 1]) / np.sqrt(1.13), (7, 10, 3)))
    assert (n[0] == 0).all()


def test_one_pixel_of_parallax_bent_is_one_pixel_of_penalty():
    """e is in pixels of parallax: depth raised by u at one pixel of a fronto-parallel plane gives |e| = 2 there."""
    depth, u = np.full((5, 5), 3.0), np.full((5, 5), 1e-5)
    depth[2, 2] += 1e-5
    e = smooth.second_differences(depth, np.ones((5, 5), bool), 3.0**2 / u)
    assert e[0, 2] == pytest.approx([0, -1, 2, -1, 0], rel=1e-4) and e[1, :, 2] == pytest.approx(e[0, 2], rel=1e-4)


def test_adam_takes_the_rate_first_and_leaves_fixed_pixels():
    depth = np.array([[1.0, 1.0, 1.0, 0.0, 2e-3]])
    gradient = np.array([[0.7, -3.0, 5.0, 1.0, 1.0]])
    length = np.array([[0.01, 0.02, 0.0, 0.01, 1.0]])
    adam = Adam.start(depth.shape, 0.9, 0.999)
    after = adam.step(depth, gradient, length, 0.5, 0.0)
    assert after == pytest.approx(np.array([[0.995, 1.01, 1.0, 0.0, NEAR]]), rel=1e-12)
    still = Adam.start(depth.shape, 0.9, 0.999).step(depth, np.zeros_like(depth), length, 0.5, 0.0)
    assert (still == depth).all()
    x, m, v = np.array([[1.0]]), 0.0, 0.0
    adam = Adam.start(x.shape, 0.9, 0.999)
    for t, g in enumerate((0.3, -0.2, 0.0), 1):  # by the book
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        want = x - 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        x = adam.step(x, np.array([[g]]), np.ones((1, 1)), 0.01, 1e-8)
        assert x == pytest.approx(want, rel=1e-14)


def test_plateau_falls_by_ten_and_ends():
    schedule = Plateau(1e-5, 2, 1e-2)
    rates = [schedule.next_rate(loss) for loss in (5, 4, 4, 4, 3, 3, 3, 3, 3)]
    assert rates == pytest.approx([1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6, 1e-7, 1e-7, 0])
    schedule = Plateau(0.02, 0, 0.01)
    assert {schedule.next_rate(loss) for loss in range(50)} == {0.02}


def test_parallax_unit_moves_a_pixel():
    depth, target, contexts = random_scene(5, contexts=1)
    scene_scale, small = median_depth(depth), 1e-6
    initial = depth / scene_scale
    state = prepare(initial, target, contexts, BASE, scene_scale, 0.05)
    here, there = (project(initial + by * state.parallax, target.camera, contexts[0].camera, 0.0, scene_scale)
                   for by in (0, small))
    moved = np.linalg.norm(there.m - here.m, axis=1) / small
    used = state.parallax.ravel() > 0
    assert used.sum() > 100 and moved[used] == pytest.approx(np.ones(used.sum()), rel=1e-3)
    assert (state.kappa[state.parallax == 0] == 0).all() and (state.parallax[depth == 0] == 0).all()


def test_distance_unit_of_a_ring_of_cameras():
    cameras = []
    for angle in np.linspace(0, 1, 5):
        R = rotation((0, angle, 0))
        cameras.append(Camera(10, 10, 10, 10, 5, 5, pose(R, np.array([100, 200, 300]) - 7 * R[2])))
    assert viewing_distance(cameras) == pytest.approx(7, rel=1e-9)
    parallel = [Camera(10, 10, 10, 10, 5, 5, pose(np.eye(3), (x, 0, 0))) for x in range(3)]
    assert np.isnan(viewing_distance(parallel))
    assert focus(cameras) == pytest.approx([100, 200, 300]) and focus(parallel) == pytest.approx([1, 0, 0])


def test_resampling_keeps_what_it_must():
    rng = np.random.default_rng(0)
    image = random_image(rng, 12, 8)
    assert resample.shrink_image(image, 6, 4) == pytest.approx(
        np.rint(np.rint(image * 255).reshape(4, 2, 6, 2, 3).mean(axis=(1, 3))) / 255, abs=1e-12)
    assert resample.shrink_image(np.full((7, 5, 3), 0.2), 3, 4) == pytest.approx(np.full((4, 3, 3), 0.2))
    assert resample.cover(7, 3).sum(axis=0) == pytest.approx(np.ones(7))
    mask = np.ones((7, 5), bool)
    mask[3, 2] = False
    assert (~resample.shrink_mask(mask, 2, 2)).sum() == 4 and resample.shrink_mask(mask[:3], 2, 1).all()
    depth = np.array([[1.0, 3.0, 0.0, 5.0], [0.0, 0.0, 0.0, 0.0]])
    assert resample.shrink_depth(depth, 2, 1) == pytest.approx(np.array([[2.0, 5.0]]))
    ramp = np.add.outer(np.arange(1, 6.0), 2 * np.arange(6.0))
    large = resample.enlarge_depth(ramp, 12, 10)
    assert large[1:-1, 1:-1] == pytest.approx(
        np.add.outer(1.25 + 0.5 * np.arange(8), 0.5 + np.arange(10)))
    ramp[2, 2] = 0
    assert (resample.enlarge_depth(ramp, 12, 10) > 0).all()
    assert resample.scaled_size(5, 1, 0.5) == (3, 1) and resample.scaled_size(48, 40, 0.5) == (24, 20)


def relief(width=48, height=40, contexts=3):
    """A textured plane with a bump seen by `contexts` + 1 cameras: exact depth of the target, and the photos."""
    def surface(x, y):
        return 1.0 + 0.1 * x + 0.03 * np.exp(-((x - 0.1)**2 + y**2) / 0.02)

    def colors(x, y):
        waves = [0.5 + 0.2 * np.sin(40 * x + 3 * c) * np.cos(35 * y - c) + 0.15 * np.sin(25 * x - 28 * y + c)
                 for c in range(3)]
        return np.stack(waves, axis=-1)

    def shot(at):
        R = rotation((-at[1], at[0], 0))
        camera = Camera(width, height, 1.3 * width, 1.3 * width, width / 2, height / 2, pose(R, at))
        rays = camera.rays() @ camera.world_to_camera[:3, :3]
        d = np.ones((height, width))
        for _ in range(200):  # the ray meets z = surface(x, y) by fixed-point steps
            point = camera.center + d[..., None] * rays
            d -= 0.5 * (point[..., 2] - surface(point[..., 0], point[..., 1]))
        point = camera.center + d[..., None] * rays
        return d, Photo(camera, np.rint(colors(point[..., 0], point[..., 1]) * 255) / 255)

    places = [(0, 0, 0), (0.2, 0, 0), (-0.15, 0.1, 0), (0, -0.2, 0.05)]
    shots = [shot(np.array(at)) for at in places[:contexts + 1]]
    return shots[0][0], shots[0][1], [photo for _, photo in shots[1:]]


@pytest.mark.parametrize("pyramid", [dict(), dict(pyramid__scales=(0.5, 1.0), pyramid__steps=(15, 25))],
                         ids=["one level", "two levels"])
def test_refinement_comes_near_the_truth(pyramid):
    truth, target, contexts = relief()
    v, u = np.mgrid[:40, :48]
    initial = truth * (1 + 0.06 * np.sin(u / 5) * np.cos(v / 6))  # up to 0.7 pixels of parallax
    initial[5, 7] = 0
    config = Config().with_settings(**{"pyramid__steps": (30,), **pyramid, "solver__rate": 0.05})
    result = refine(initial, target, contexts, config)
    valid = initial > 0
    before, after = (np.abs(d - truth)[valid].mean() for d in (initial, result.depth))
    assert after < 0.4 * before and result.losses[-1] < result.losses[0]
    assert (result.depth[~valid] == 0).all() and (result.depth[valid] > 0).all()
    assert result.steps == list(config.pyramid.steps) and len(result.losses) == sum(result.steps)


def test_refinement_is_free_of_scale_and_runs_alike_twice():
    truth, target, contexts = relief(24, 20, 2)
    initial = truth * 1.003
    config = Config().with_settings(pyramid__steps=(5,))
    one = refine(initial, target, contexts, config)
    assert refine(initial, target, contexts, config).depth.tobytes() == one.depth.tobytes()
    large = []
    for photo in (target, *contexts):
        moved = photo.camera.world_to_camera.copy()
        moved[:3, 3] *= 1e3
        c = photo.camera
        large.append(Photo(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, moved), photo.image))
    other = refine(initial * 1e3, large[0], large[1:], config)
    assert np.abs(other.depth / 1e3 / one.depth - 1).max() < 1e-8


def test_what_moves_too_far_gets_its_input_back():
    truth, target, contexts = relief(24, 20, 2)
    initial = truth * 1.003
    config = Config().with_settings(pyramid__steps=(5,), solver__max_move=0.0)
    assert (refine(initial, target, contexts, config).depth == initial).all()


def test_gradient_points_to_the_truth():
    truth, target, contexts = relief()
    scene_scale = median_depth(truth)
    state = prepare(truth / scene_scale, target, contexts, BASE, scene_scale, 0.05)
    error = 0.3 * state.parallax
    _, gradient = loss_and_gradient(truth / scene_scale + error, target, contexts, BASE, state)
    assert closeness(gradient * state.parallax, error / state.parallax.clip(1e-9)).cosine > 0.5
