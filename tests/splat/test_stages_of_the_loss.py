"""Stages between an image and what it passes back, each by itself against its twin: the order-free image, SSIM, the
loss, its schedule, and the exposure fit."""

import numpy as np
import pyopencl as cl
import pytest
from support.close import assert_kernel_close
from support.kernel_cases import Scene
from support.stage import ALPHA, ORDER_FREE, Stage
from twins import exposure as exposure_twin
from twins import loss as losses
from twins.composite import _order_free_vjp
from twins.photo_loss import render
from twins.smooth import smoothness
from twins.step import Plateau

from pagas_cl.method.splat import composite, exposure, loss, project, smooth
from pagas_cl.method.splat.constants import DONE, LOSS, LOSS_ONE, MARGIN, RATE
from pagas_cl.method.splat.options import fixed_bits, heaviest_pixel, pitch
from pagas_cl.method.splat.step import Solver
from pagas_cl.runtime.memory import download
from pagas_cl.runtime.program import run_once
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels

FOLLOWED = dict(solver__patience=5)         # the loss is summed only where the schedule follows it


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.make(17, width=45, height=37, contexts=2, masks=True)


def total_of(device, stage, views: int, pixels: int) -> float:
    """The summed loss of a view, as that of one view alone."""
    found = download(device, stage.buffers.loss, 1, np.int64)[0] / LOSS_ONE * views
    cl.enqueue_fill_buffer(device.queue, stage.buffers.loss, np.uint32(0), 0, 8)
    return float(found)


@pytest.mark.parametrize("grey", [False, True], ids=["colour", "grey"])
def test_the_order_free_image(device, scene, grey):
    """Sums of weights and of weighted colours, whole numbers."""
    config = ORDER_FREE.with_settings(loss__grey=grey)
    stage, channels = Stage.make(device, config, scene), 1 if grey else 3
    one = 2.0 ** fixed_bits(heaviest_pixel(scene.target.camera))
    for view, context in zip(stage.views[1:], scene.contexts):
        shape = (view.size.height, view.size.width, channels + 1)
        stage.put(rendered=np.zeros(shape))             # as the loss leaves it
        sums = stage.run(composite.launches(stage.programs, stage.buffers, view), "rendered", shape, np.uint32) / one
        want = render(scene.moved.astype(np.float64), scene.target, context, config, stage.twin)
        weight = want.total.reshape(shape[:2])
        photo = losses.comparable(context.image, config.loss)
        filled = np.minimum(1, weight)[..., None]
        average = photo + (want.color - photo) / np.where(filled > 0, filled, 1)
        assert (weight > 0.5).mean() > 0.3
        assert_kernel_close(sums[..., 0], weight)
        assert_kernel_close(sums[..., 1:], average * weight[..., None])


def image_of(stage, view, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random colours (H, W, 3) and coverage (H, W) in buffers.rendered, as the alpha blend leaves them."""
    rng = np.random.default_rng(seed)
    image = rng.random((view.size.height, view.size.width, 4)).astype(np.float32)
    stage.put(rendered=image)
    return image[..., :3].astype(np.float64), image[..., 3].astype(np.float64)


def lengthened(packed) -> list[np.ndarray]:
    """Three arrays of floats of 21 bits from two of integers, (2, ...)."""
    one, other = packed
    bits = one & 0xfffff800, one << 21 | (other & 0x7ff) << 10, other & 0xfffff800
    return [part.view(np.float32).astype(np.float64) for part in map(np.ascontiguousarray, bits)]


@pytest.mark.parametrize("settings", [{}, dict(loss__structure=True), dict(loss__robust=0.6)],
                         ids=["plain", "structure", "robust"])
def test_ssim(device, scene, settings):
    """What ssim.cl leaves of each window, blurred back to pixels by the twin, and the sum of 1 - SSIM."""
    config = ALPHA.with_settings(loss__ssim=1.0, loss__unseen_mask=False, **FOLLOWED, **settings)
    stage = Stage.make(device, config, scene)
    for number, context in enumerate(scene.contexts, start=1):
        view = stage.views[number]
        color, _ = image_of(stage, view, number)
        run_once(device.queue, loss.launches(stage.programs, stage.buffers, view, 1)[:1])
        width, height, plane = view.size.width, view.size.height, pitch(view.size.width) * view.size.height
        packed = download(device, stage.buffers.partials, (3 * plane + MARGIN, 2), np.uint32)[MARGIN:]
        partials = lengthened(packed.reshape(3, height, -1, 2)[:, :height - 10, :width - 10].transpose(3, 1, 2, 0))
        x = color if context.mask is None else np.where(context.mask[..., None], color, context.image)
        v_mean, v_both, v_product = map(losses.blur_vjp, partials)
        value, gradient = losses.ssim(x, context.image, config.loss.robust, config.loss.structure)
        assert_kernel_close(v_mean + x * v_both + (context.image - x) * v_product,
                            gradient * partials[0].size)
        assert total_of(device, stage, 1, view.size.pixels) == pytest.approx(1 - value, rel=1e-5)


@pytest.mark.parametrize("settings", [
    {}, dict(loss__ssim=0.0, loss__huber=0.05), dict(loss__robust=0.4, loss__gradient_weight=False),
    dict(loss__coverage_weight=False, loss__unseen_mask=False, loss__structure=True)],
    ids=["paper", "L1, huber", "robust", "no weights"])
def test_the_loss_of_an_image(device, scene, settings):
    """N dL/dC and N dL/dA of an image of colours and coverage, and its loss, SSIM included."""
    config = ALPHA.with_settings(**FOLLOWED, **settings)
    stage, n = Stage.make(device, config, scene), scene.moved.size
    stage.put(depth=scene.initial)
    run_once(device.queue, project.before_steps(stage.programs, stage.buffers, stage.views[0], 2))
    for number, context in enumerate(scene.contexts, start=1):
        view = stage.views[number]
        color, coverage = image_of(stage, view, number)
        got = stage.run(loss.launches(stage.programs, stage.buffers, view, 2), "v_rendered", (*coverage.shape, 4))
        mask = np.ones(coverage.shape, bool) if context.mask is None else context.mask
        value, v_color, v_coverage = losses.photometric(color, coverage, context.image, config.loss,
                                                        stage.twin.seen[number - 1], mask)
        assert_kernel_close(got[..., :3], v_color * n / 2)
        assert_kernel_close(got[..., 3], np.where(mask, v_coverage, 0) * n / 2)
        assert total_of(device, stage, 2, n) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("settings", [{}, dict(loss__grey=True)], ids=["colour", "grey"])
def test_the_loss_of_an_order_free_image(device, scene, settings):
    """(G, h) of each pixel gives dL/dalpha = G . c + h of all Gaussians in it."""
    config = ORDER_FREE.with_settings(**settings)
    stage, channels = Stage.make(device, config, scene), 1 if config.loss.grey else 3
    colors = losses.comparable(scene.target.image, config.loss).reshape(-1, channels)
    for view, context in zip(stage.views[1:], scene.contexts):
        run_once(device.queue, composite.launches(stage.programs, stage.buffers, view))
        shape = (view.size.pixels, channels + 1)
        got = stage.run(loss.launches(stage.programs, stage.buffers, view, 1), "v_rendered", shape)
        rendered = render(scene.moved.astype(np.float64), scene.target, context, config, stage.twin)
        mask = np.ones(rendered.coverage.shape, bool) if context.mask is None else context.mask
        _, v_color, v_coverage = losses.photometric(rendered.color, rendered.coverage,
                                                    losses.comparable(context.image, config.loss), config.loss, None,
                                                    mask)
        held = rendered.covered.ravel()
        want = _order_free_vjp(rendered, np.where(held[:, None], v_color.reshape(-1, channels), 0),
                               np.where(held, v_coverage.ravel(), 0)) * scene.moved.size
        pairs = rendered.pairs
        found = (got[pairs.pixel, :channels] * colors[pairs.gaussian]).sum(axis=1) + got[pairs.pixel, channels]
        assert_kernel_close(found, want)


def test_the_plateau(device, scene):
    """Better and worse losses: the rate falls by ten after each `patience` in vain, and the level ends at the floor."""
    config = ORDER_FREE.with_settings(solver__patience=2, solver__rate=0.5, solver__rate_floor=0.005)
    stage, twin = Stage.make(device, config, scene), Plateau(0.5, 2, 0.005)
    solver = Solver(stage.programs, stage.buffers, Size(45, 37), 1.0)
    series, rates, done = [3.0, 2.0, 2.5, 2.25, 1.5, 1.5, 1.75, 1.25, 1.5, 1.5], [], []
    for number, value in enumerate(series):
        cl.enqueue_copy(device.queue, stage.buffers.loss, np.array([round(value * LOSS_ONE)], np.int64))
        solver.enqueue(number, len(series))
        state = download(device, stage.buffers.state, 8)
        rates.append(float(state[RATE]))
        done.append(bool(state[DONE]))
    want = [twin.next_rate(value) for value in series]
    assert done == [rate == 0 for rate in want] and any(done) and not done[0]
    assert [r for r, ended in zip(rates, done) if not ended] == pytest.approx([rate for rate in want if rate], rel=1e-6)
    assert download(device, stage.buffers.history, len(series)) == pytest.approx(series)
    assert download(device, stage.buffers.loss, 1, np.int64)[0] == 0


@pytest.mark.parametrize("kind", ["planar", "normal"])
def test_the_loss_of_the_smoothness(device, scene, kind):
    config = ORDER_FREE.with_settings(smoothness__kind=kind, smoothness__weight=0.3, smoothness__discontinuity=0.8,
                                      **FOLLOWED)
    stage, s = Stage.make(device, config, scene), config.smoothness
    stage.put(kappa=stage.twin.kappa, weights=1 - (1.0 if kind == "normal" else s.texture) * stage.twin.texture)
    state = stage.run(smooth.launches(stage.programs, stage.buffers, stage.views[0], s.weight), "state", 8)
    depth = scene.moved.astype(np.float64)
    want, _ = smoothness(depth, depth > 0, s, stage.twin.kappa, scene.target.camera.rays(), stage.twin.texture)
    assert state[LOSS] == pytest.approx(want, rel=1e-5) and want > 0


def test_the_exposure_fit(device, scene):
    """From colours alone: gains and offsets with noise, outliers, clipped samples; a view that shows too little."""
    stage, rng = Stage.make(device, ORDER_FREE.with_settings(loss__exposure=True), scene), np.random.default_rng(5)
    count = stage.buffers.matches.size // (4 * 8 * 2)
    matches = np.zeros((2, count, 8), np.float32)
    own = rng.uniform(0.1, 0.9, (count, 3))
    true = np.array([[0.8, 0.05], [1.1, -0.03], [0.95, 0.02]])
    other = own * true[:, 0] + true[:, 1] + 0.004 * rng.standard_normal(own.shape)
    other[::9] = rng.uniform(0.1, 0.9, other[::9].shape)
    matches[0, :, :3], matches[0, :, 3], matches[0, :, 4:7] = own, np.where(np.arange(count) % 5, 2, 1), other
    matches[1, :40] = matches[0, :40]
    stage.put(matches=matches)
    found = stage.run([exposure.fit(stage.programs, stage.buffers, stage.views[1:])], "exposure", (3, 2, 3))
    for view in (1, 2):
        usable = matches[view - 1, matches[view - 1, :, 3] == 2]
        want = exposure_twin.fit(usable[:, :3], usable[:, 4:7])
        assert np.abs(found[view].T - want).max() < 1e-3
    assert np.abs(found[1].T - true).max() < 0.01 and (found[2] == [[1] * 3, [0] * 3]).all()
