"""Kernels against their float64 twins: the gradient of one step, a whole level, and the same bytes every time."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pyopencl as cl
import pytest
from support.close import assert_kernel_close
from support.effects import GRADIENT_CASES
from support.kernel_cases import SEES_LOSS, Scene, device_gradient, start_level, twin_gradient, view_of
from twins.level import prepare, run_level
from twins.pairs import candidates, nearest_surface
from twins.project import project as twin_project

from pagas_cl.config.presets import BALANCED, PAPER
from pagas_cl.method.splat import project
from pagas_cl.method.splat.buffers import LevelBuffers
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.options import SCALAR, Programs, Tile
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.runtime.memory import download, upload
from pagas_cl.runtime.program import run_once

pytestmark = pytest.mark.kernels

PLAIN = BALANCED.with_settings(smoothness__kind="none", smoothness__weight=0.0,
                               solver__views_per_step=0, **SEES_LOSS)
PAPER = PAPER.with_settings(**SEES_LOSS)
CASES = {
    "order-free": (PLAIN, {}),
    "order-free narrow": (PLAIN, dict(splatting__radius=0.5)),
    "order-free wide": (PLAIN, dict(splatting__radius=3.0)),
    "order-free grey": (PLAIN, dict(loss__grey=True)),
    "structure, L1": (PLAIN, dict(loss__structure=True)),
    "narrow huber": (PLAIN, dict(loss__huber=2e-4)),      # plain L1: the alpha blend's
    "wide huber": (PLAIN, dict(loss__huber=0.1)),
    "robust": (PLAIN, dict(loss__robust=0.6)),
    "robust, wide huber": (PLAIN, dict(loss__robust=0.2, loss__huber=0.04)),
    "planar discontinuity": (PLAIN, dict(smoothness__kind="planar", smoothness__weight=0.1,
                                         smoothness__discontinuity=0.3)),
    "L1 only": (PLAIN, dict(loss__ssim=0.0)),
    "SSIM only": (PLAIN, dict(loss__ssim=1.0)),
    "no weights": (PLAIN, dict(loss__gradient_weight=False, loss__coverage_weight=False)),
    "target view": (PLAIN, dict(loss__target_view=True)),
    "alpha": (PAPER, {}),
    "alpha no low-pass": (PAPER, dict(splatting__low_pass=0.0)),
    "alpha normalised": (PAPER, dict(splatting__normalize=True)),
    "alpha narrow": (PAPER, dict(splatting__radius=0.5)),
    "alpha grey": (PAPER, dict(loss__grey=True)),
    "alpha relative": (PAPER, dict(splatting__depth_relative=0.01)),
    "alpha wide": (PAPER, dict(splatting__radius=3.0)),
    "alpha crowded": (PAPER, dict(splatting__radius=5.0, splatting__occlusion=False)),
    "alpha huber": (PAPER, dict(loss__huber=0.02)),
    "alpha L1 only": (PAPER, dict(loss__ssim=0.0)),
    **{name: (PLAIN, settings) for name, settings in GRADIENT_CASES.items()},
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Odd sizes, masks, holes, a step in depth; no two depths so close that float32 swaps their order."""
    return Scene.make(17, width=45, height=37, contexts=3, masks=True)


@pytest.mark.parametrize("name", CASES)
def test_gradient_equals_the_twin(device, scene, name):
    base, settings = CASES[name]
    config = base.with_settings(**settings)
    got, loss = device_gradient(device, config, scene)
    want, value = twin_gradient(config, scene)
    assert_kernel_close(got, want)
    assert loss == pytest.approx(value, rel=1e-5)            # what the schedule follows, smoothness included


@pytest.mark.parametrize("size", [(10, 30), (33, 11), (52, 8), (53, 17), (97, 51)])
@pytest.mark.parametrize("base", [PLAIN, PAPER], ids=["order-free", "alpha"])
def test_any_image_size(device, base, size):
    """Smaller than a window, one window high, one tile, a pixel more than a tile, and large enough for vectors."""
    scene = Scene.make(7, width=size[0], height=size[1], contexts=2)
    got, loss = device_gradient(device, base, scene)
    want, value = twin_gradient(base, scene)
    assert_kernel_close(got, want)
    assert loss == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("base", [PLAIN, PAPER, PAPER.with_settings(splatting__radius=3.0)],
                         ids=["order-free", "alpha", "alpha wide"])
def test_same_bytes_every_time(device, scene, base):
    first, second = device_gradient(device, base, scene), device_gradient(device, base, scene)
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1] == second[1]


@pytest.mark.parametrize("base", [BALANCED, PAPER], ids=["order-free", "alpha"])
def test_level_follows_the_twin(device, scene, base):
    """Eight steps of Adam stay within a few hundredths of the way that they go."""
    config = base.with_settings(solver__views_per_step=2)
    level, initial = start_level(device, config, scene, raised=False), scene.initial.astype(np.float64)
    assert level.run(8) == 8
    got = level.read("depth", initial.shape)
    level.release()
    state = prepare(initial, scene.target, scene.contexts, config, scene.scene_scale, scene.depth_threshold(config))
    if config.solver.rate_unit == "distance":
        object.__setattr__(state, "distance", 1.0)          # what the level was given
    want, _ = run_level(scene.moved.astype(np.float64), scene.target, scene.contexts, config, state, 8)
    way, error = np.abs(want - scene.moved), np.abs(got - want)
    assert np.median(way[initial > 0]) > 0
    assert error.mean() < 0.03 * way.mean()


@pytest.mark.parametrize("kind", ["planar", "normal"])
def test_the_schedule_follows_the_whole_loss(device, scene, kind):
    """L = L_c + L_s, step by step (method section 5)."""
    config = PAPER.with_settings(smoothness__kind=kind, smoothness__weight=100.0, solver__rate=1e-3,
                                 solver__damping=1e-3)
    level = start_level(device, config, scene)
    assert level.run(4) == 4
    got = level.read("history", 4)
    level.release()
    state = prepare(scene.initial.astype(np.float64), scene.target, scene.contexts, config, scene.scene_scale,
                    scene.depth_threshold(config))
    object.__setattr__(state, "distance", 1.0)              # what the level was given
    start = scene.moved.astype(np.float64)
    _, want = run_level(start, scene.target, scene.contexts, config, state, 4)
    _, photos = run_level(start, scene.target, scene.contexts, config.with_settings(smoothness__weight=0.0), state, 1)
    assert want[0] > 1.5 * photos[0], "the smoothness is a good part of the loss here"
    assert got == pytest.approx(np.array(want), rel=1e-3)


def level_launches(device, config, scene):
    """Every kernel of a step that was bound with its tile."""
    level = start_level(device, config, scene)
    return [launch for launch in level.launches_of(0) if hasattr(launch, "kernel")]


@pytest.mark.parametrize("tiles", [SCALAR, (Tile(16, 8, 32, 1, 4), Tile(24, 4, 64, 1, 4))], ids=["gpu", "small"])
@pytest.mark.parametrize("base", [PLAIN, PAPER], ids=["order-free", "alpha"])
def test_tiles_make_no_difference(device, monkeypatch, base, tiles):
    """Whatever the tile and the number of work-items that share it; this is what runs on a GPU."""
    scene = Scene.make(6, width=97, height=51, contexts=2)
    want, value = device_gradient(device, base, scene)
    monkeypatch.setattr("pagas_cl.method.splat.options.choose_tiles", lambda device, sizes: tiles)
    got, loss = device_gradient(device, base, scene)
    assert_kernel_close(got, want)
    assert np.abs(got - want).max() <= 2e-5 * np.abs(want).max()
    assert loss == pytest.approx(value, rel=1e-6)


def test_strips_make_no_difference(device, monkeypatch, scene):
    """However many threads share an image by its rows (splat.clh): the same bytes."""
    want, value = device_gradient(device, PLAIN, scene)
    for number in (1, 7, scene.contexts[0].camera.height):
        monkeypatch.setattr("pagas_cl.method.splat.options.strips", lambda device, size, number=number: (number, 1))
        got, loss = device_gradient(device, PLAIN, scene)
        assert got.tobytes() == want.tobytes()
        assert loss == value


@pytest.mark.parametrize("base", [PLAIN, PAPER], ids=["order-free", "alpha"])
def test_a_gpu_can_hold_it(device, monkeypatch, scene, base):
    """At most 32 kB of local memory and 256 work-items: PoCL would allow far more."""
    monkeypatch.setattr("pagas_cl.method.splat.options.choose_tiles", lambda device, sizes: SCALAR)
    info = cl.kernel_work_group_info
    for launch in level_launches(device, base, scene):
        kernel = launch.cl_kernel
        assert kernel.get_work_group_info(info.LOCAL_MEM_SIZE, device.cl_device) <= 32 * 1024, launch.stage
        assert np.prod(launch.local_size or 1) <= 256, launch.stage


def test_a_stage_needs_only_its_own_buffers(device, scene):
    """No level: programs, three buffers and a view are enough for the nearest surfaces of a context photo."""
    photos, views = PhotoStore(device), [view_of(p) for p in (scene.target, *scene.contexts)]
    given = LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene.scene_scale,
                       scene.depth_threshold(PLAIN), 1.0, len(scene.contexts))
    view = given.views(PLAIN)[1]
    buffers = LevelBuffers(depth=upload(device, scene.moved), cameras=upload(device, given.camera_table),
                           z_first=upload(device, np.zeros(view.size.pixels, np.float32)))
    run_once(device.queue, project.nearest(Programs(device, PLAIN, given.cameras), buffers, view))
    found = download(device, buffers.z_first, view.size.pixels)
    want = nearest_surface(candidates(twin_project(scene.moved.astype(np.float64), scene.target.camera,
                                                   scene.contexts[0].camera, PLAIN.splatting.low_pass,
                                                   scene.scene_scale), *view.size, PLAIN.splatting),
                           view.size.pixels)
    same = np.isclose(found, want, rtol=1e-5)
    assert same.mean() > 0.99 and np.isfinite(want).mean() > 0.3
    buffers.release()
    assert buffers.held() == []


def test_every_buffer_says_what_it_holds():
    for own in fields(LevelBuffers):
        assert {"shape", "dtype", "unit"} <= own.metadata.keys() and own.metadata["purpose"], own.name
