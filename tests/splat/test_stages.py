"""Each stage of a step by itself against its twin: programs, buffers and a view, and no level around them."""

from __future__ import annotations

import numpy as np
import pytest
from support.close import assert_kernel_close
from support.kernel_cases import Scene
from support.stage import ALPHA, BLENDS, ORDER_FREE, Stage
from twins import loss as losses
from twins import resample
from twins.composite import composite_vjp
from twins.gradient_filter import filter_gradient
from twins.photo_loss import render
from twins.smooth import smoothness
from twins.step import Adam

from pagas_cl.method.splat import composite, gradient_filter, project, smooth
from pagas_cl.method.splat.resample import Resampler
from pagas_cl.method.splat.step import Solver
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import run_once
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.make(17, width=45, height=37, contexts=2, masks=True)


def test_depth_per_parallax_and_what_is_seen(device, scene):
    stage = Stage.make(device, ORDER_FREE.with_settings(loss__unseen_mask=True), scene)
    stage.put(depth=scene.initial)
    launches = project.before_steps(stage.programs, stage.buffers, stage.views[0], len(scene.contexts))
    found = stage.run(launches, "depth_per_parallax", scene.initial.shape)
    want = stage.twin.parallax
    assert ((found > 0) == (want > 0)).mean() > 0.999
    assert_kernel_close(found, want, (found > 0) & (want > 0))
    for bits, seen in zip(stage.buffers.seen, stage.twin.seen):
        packed = download(device, bits, seen.size // 32 + 1, np.uint32)
        got = np.unpackbits(packed.view(np.uint8), bitorder="little")[:seen.size].reshape(seen.shape)
        assert (got == seen).mean() > 0.999 and seen.any() and not seen.all()


def test_the_alpha_blend(device, scene):
    stage = Stage.make(device, ALPHA, scene)
    for view, context in zip(stage.views[1:], scene.contexts):
        shape = (view.size.height, view.size.width, 4)
        rendered = stage.run(composite.launches(stage.programs, stage.buffers, view), "rendered", shape)
        want = render(scene.moved.astype(np.float64), scene.target, context, ALPHA, stage.twin)
        assert_kernel_close(rendered[..., 3], want.coverage)
        assert_kernel_close(rendered[..., :3], want.color, np.repeat(want.covered[..., None], 3, axis=2))
        run_once(device.queue, composite.backward(stage.programs, stage.buffers, stage.views[0]))     # empty bins again


@BLENDS
def test_the_way_back(device, scene, config):
    """From an image of slopes to the depths. Order-free (G, h) is dL/dalpha = G . c + h; alpha (dL/dC, dL/dA)."""
    stage, rng, want = Stage.make(device, config, scene), np.random.default_rng(3), np.zeros(scene.moved.size)
    colors = losses.comparable(scene.target.image, config.loss).reshape(-1, 3)
    for view, context in zip(stage.views[1:], scene.contexts):
        run_once(device.queue, composite.launches(stage.programs, stage.buffers, view))
        slopes = rng.standard_normal((view.size.height, view.size.width, 4)).astype(np.float32)
        stage.put(v_rendered=slopes)
        got = stage.run(composite.backward(stage.programs, stage.buffers, view), "gradient", scene.moved.shape)
        rendered = render(scene.moved.astype(np.float64), scene.target, context, config, stage.twin)
        if config is ALPHA:
            want += composite_vjp(rendered, slopes[..., :3].astype(np.float64), slopes[..., 3].astype(np.float64))
        else:
            pairs, flat = rendered.pairs, slopes.reshape(-1, 4).astype(np.float64)
            v_alpha = (flat[pairs.pixel, :3] * colors[pairs.gaussian]).sum(axis=1) + flat[pairs.pixel, 3]
            want += np.bincount(pairs.gaussian, v_alpha * pairs.alpha_d, len(want))
        assert_kernel_close(got, want.reshape(got.shape))


@pytest.mark.parametrize("kind", ["planar", "normal"])
def test_smoothness(device, scene, kind):
    config = ORDER_FREE.with_settings(smoothness__kind=kind, smoothness__weight=0.3, smoothness__discontinuity=0.8,
                                      solver__gradient_filter=0)
    stage = Stage.make(device, config, scene)
    target, s = stage.views[0], config.smoothness
    stage.put(depth=scene.initial, depth_per_parallax=stage.twin.parallax)
    kappa = stage.run(smooth.before_steps(stage.programs, stage.buffers, target), "kappa", scene.moved.shape)
    assert_kernel_close(kappa, stage.twin.kappa)
    stage.put(depth=scene.moved)
    given = stage.programs, stage.buffers, target, s.weight
    launches = gradient_filter.launches(*given) + smooth.launches(*given)
    got = stage.run(launches, "followed" if kind == "planar" else "gradient", scene.moved.shape)
    depth = scene.moved.astype(np.float64)
    _, want = smoothness(depth, depth > 0, s, stage.twin.kappa, scene.target.camera.rays(), stage.twin.texture)
    assert_kernel_close(got, want * depth.size)


@pytest.mark.parametrize("radius", [1, 3])
def test_gradient_filter(device, scene, radius):
    config = ORDER_FREE.with_settings(solver__gradient_filter=radius, smoothness__kind="none")
    stage = Stage.make(device, config, scene)
    gradient = np.random.default_rng(0).standard_normal(scene.moved.shape).astype(np.float32)
    stage.put(gradient=gradient, depth_per_parallax=stage.twin.parallax)
    launches = gradient_filter.launches(stage.programs, stage.buffers, stage.views[0], 0.0)
    got = stage.run(launches, "followed", gradient.shape)
    assert_kernel_close(got, filter_gradient(gradient.astype(np.float64), stage.twin.parallax, radius))


def test_adam(device, scene):
    config = ORDER_FREE.with_settings(solver__final_rate=1.0)
    stage, rng, s = Stage.make(device, config, scene), np.random.default_rng(1), config.solver
    solver = Solver(stage.programs, stage.buffers, Size(45, 37), 1.0)
    stage.put(depth_per_parallax=stage.twin.parallax)
    twin, want = Adam.start(scene.moved.shape, s.beta1, s.beta2), scene.moved.astype(np.float64)
    for number in range(4):
        gradient = rng.standard_normal(want.shape).astype(np.float32)
        stage.put(followed=gradient)
        solver.enqueue(number, 4)
        want = twin.step(want, gradient.astype(np.float64), stage.twin.parallax, s.rate, s.damping_at(number, 4))
    got = stage.run([], "depth", want.shape)
    assert_kernel_close(got - scene.moved, want - scene.moved)
    fixed = (scene.moved <= 0) | (stage.twin.parallax <= 0)
    assert (got[fixed] == scene.moved[fixed]).all() and fixed.any()


@pytest.mark.parametrize("to", [Size(22, 18), Size(31, 11), Size(1, 1)], ids=str)
def test_resampling(device, scene, to):
    size, resampler = Size(45, 37), Resampler(device, ORDER_FREE)
    image = np.random.default_rng(2).integers(0, 256, (37, 45, 4), np.uint8)
    out = upload(device, np.zeros((to.height, to.width, 4), np.uint8))
    resampler.shrink_photo(upload(device, image), size, out, to)
    want = resample.shrink_image(image[..., :3] / 255.0, *to) * 255
    got = download(device, out, (to.height, to.width, 4), np.uint8)[..., :3]
    assert np.abs(got - want).max() <= 1 and (got == np.rint(want)).mean() > 0.99      # float32 may round a tie
    small, full = (upload(device, np.zeros(n, np.float32)) for n in (to.pixels, size.pixels))
    resampler.shrink_depth(upload(device, scene.initial), size, small, to)
    got = download(device, small, (to.height, to.width)).astype(np.float64)
    want = resample.shrink_depth(scene.initial.astype(np.float64), *to)
    assert ((got > 0) == (want > 0)).all() and np.abs(got - want).max() <= 1e-6 * want.max()
    resampler.enlarge_depth(small, to, upload(device, scene.initial), full, size)
    back = download(device, full, scene.initial.shape).astype(np.float64)
    want = resample.enlarge_depth(got, *size)
    both = (back > 0) & (scene.initial > 0)
    assert ((back > 0) <= (scene.initial > 0)).all() and both.mean() > 0.9
    assert np.abs(back - want)[both].max() <= 1e-6 * want.max()
