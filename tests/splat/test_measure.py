"""What is measured on the device, sample by sample and summed up, against float64 twins."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.kernel_cases import Scene, view_of
from support.scenes import relief_scene
from twins import exposure as exposure_twin
from twins import measure as twin
from twins.level import prepare
from twins.photo_loss import Photo

from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import exposure, project
from pagas_cl.method.splat.buffers import MOST_SAMPLES, SampleGrid
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.measure import _ROWS, ImageNoise, Probe, Rows
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.runtime.program import run_once
from pagas_cl.scene.camera import Size

pytestmark = pytest.mark.kernels

MOVES = [(float(shift), 0.0) for shift in twin.SHIFTS] + [(0.0, offset) for offset in (-2.0, -1.0, 1.0, 2.0)]


@pytest.fixture(scope="module")
def scene():
    return Scene.make(17, width=45, height=37, contexts=2, masks=True)


@pytest.fixture(scope="module")
def smooth_scene():
    """Without holes, and of different exposure: whole patches are seen."""
    made = relief_scene(60, 45, 2, held_out=0, steps=0, exposure=0.3, contrast=1.5)
    target, *contexts = [Photo.from_view(view) for view in made.views]
    depth = made.initial_depth(made.cameras[0]).astype(np.float64)
    scene_scale = float(np.median(depth))
    return Scene((depth / scene_scale).astype(np.float32), (depth / scene_scale).astype(np.float32), scene_scale,
                 target, contexts)


@pytest.fixture
def probe(device, scene):
    yield from probe_of(device, scene)


@pytest.fixture
def smooth_probe(device, smooth_scene):
    yield from probe_of(device, smooth_scene)


def probe_of(device, scene):
    views, photos = [view_of(p) for p in (scene.target, *scene.contexts)], PhotoStore(device)
    given = LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene.scene_scale,
                       scene.depth_threshold(BALANCED),
                       1.0, 2)
    probe = Probe(device, BALANCED, given, lambda out: cl.enqueue_copy(device.queue, out, scene.initial))
    assert probe.grid.stride == 1 and (probe.grid.down, probe.grid.across) == scene.initial.shape    # every pixel
    yield probe
    probe.release()


def nearest(probe, number):
    return project.nearest(probe.programs, probe.buffers, probe.views[number - 1])


def match(probe, number):
    return exposure.match(probe.programs, probe.buffers, probe.views[number - 1])


def read(device, buffer, shape):
    out = np.empty(shape, np.float32)
    cl.enqueue_copy(device.queue, out, buffer)
    return out


def rows_of(device, probe, view):
    shape = len(probe.views), len(_ROWS), *probe.target.size.shape
    return dict(zip([name for name, *_ in _ROWS], read(device, probe.view_samples.values, shape)[view - 1]))


@pytest.mark.parametrize("number", [1, 2])
def test_costs_of_moved_depths_equal_the_twin(device, scene, probe, number):
    initial, context = scene.initial.astype(np.float64), scene.contexts[number - 1]
    state = prepare(initial, scene.target, scene.contexts, BALANCED, scene.scene_scale, scene.depth_threshold(BALANCED))
    run_once(device.queue, [*nearest(probe, number), *probe.sample(probe.views[number - 1])])
    got, rows = read(device, probe.buffers.costs, (len(MOVES), *initial.shape)), rows_of(device, probe, number)
    seen = rows["hidden"] == 0
    assert seen.mean() > 0.2
    costs = np.stack([twin.moved_cost(initial, state.parallax, scene.target, context, shift, scene.scene_scale,
                                      epipolar_offset)
                      for shift, epipolar_offset in MOVES])
    same = ((costs == twin.UNDEFINED) == (got == twin.UNDEFINED))[:, seen]
    assert same.mean() > 0.99                         # a patch pixel exactly on the photo's edge may fall either way
    difference = np.abs(costs - got)[:, seen]
    assert np.quantile(difference[same], 0.99) < 1e-3
    epipolar_offset = np.nansum([rows[f"epipolar_offset {k}"] for k in range(4)], axis=0)
    want = twin.least_at(got[[7, 8, 3, 9, 10]])
    assert np.isfinite(want[seen]).mean() > 0.05
    assert np.abs(np.nan_to_num(want) - epipolar_offset)[seen].max() < 1e-3


@pytest.mark.parametrize("number", [1, 2])
def test_samples_of_a_view_equal_the_twin(device, scene, probe, number):
    """Hidden or not, and how large, with something in front of half of the photo."""
    context = scene.contexts[number - 1]
    size = context.camera.width, context.camera.height
    run_once(device.queue, nearest(probe, number))
    z_first = read(device, probe.buffers.z_first, size[::-1])
    z_first[:, :size[0] // 2] = np.minimum(z_first[:, :size[0] // 2], 0.3)
    cl.enqueue_copy(device.queue, probe.buffers.z_first, z_first)
    run_once(device.queue, probe.sample(probe.views[number - 1])[:1])
    got = rows_of(device, probe, number)
    initial, near = (array.astype(np.float64) for array in (scene.initial, z_first))
    given = initial, scene.target, context, near, probe.views[number - 1].depth_threshold, scene.scene_scale
    hidden, large = twin.sampled(*given, BALANCED.splatting.low_pass)
    assert min((hidden == 0).mean(), (hidden == 1).mean(), np.isnan(hidden).mean()) > 0.05
    same = np.isclose(got["hidden"], hidden, equal_nan=True)
    assert same.mean() > 0.995                             # near a pixel's edge it may read the next pixel
    assert (np.isnan(got["size"]) == np.isnan(large))[same].all()
    known = same & np.isfinite(large)
    assert np.abs(got["size"] / np.where(known, large, 1) - 1)[known].max() < 1e-4
    moved = twin.parallax(initial, scene.target, context, scene.scene_scale)
    known = np.isfinite(got["parallax"])
    assert (known == np.isfinite(got["hidden"])).all() and np.allclose(got["parallax"][known], moved[known], rtol=1e-3)
    assert all(np.isnan(got[name]).all() for name in got if name not in ("hidden", "size", "parallax"))


def test_judgement_of_samples_equals_the_twin(device, scene, probe):
    """Costs of all kinds in both views, added up: matching, better at another depth, other content, no texture."""
    rng, shape, names = np.random.default_rng(3), scene.initial.shape, [name for name, *_ in _ROWS]
    values = np.full((2, len(names), *shape), np.nan, np.float32)
    values[:, names.index("hidden")] = rng.choice([0, 1, np.nan], (2, *shape))
    values[:, names.index("specularity")] = rng.choice([0.01, 0.02, np.nan], (2, *shape))
    costs = rng.uniform(0, 1, (2, 1, *shape)) * rng.uniform(0.9, 1.1, (2, len(MOVES), *shape))
    costs = np.where(rng.uniform(size=costs.shape) < 0.03, twin.UNDEFINED, costs).astype(np.float32)
    cl.enqueue_copy(device.queue, probe.view_samples.values, values)
    totals = np.zeros((2 + len(twin.SHIFTS), *shape))
    for view in (1, 2):
        cl.enqueue_copy(device.queue, probe.buffers.costs, costs[view - 1])
        run_once(device.queue, probe.sample(probe.views[view - 1])[2:])
        totals += twin.votes(costs[view - 1], values[view - 1, names.index("hidden")] == 0)
    assert np.abs(read(device, probe.buffers.totals, totals.shape) - totals).max() < 1e-6
    for view in (1, 2):
        got, want = rows_of(device, probe, view), twin.like(costs[view - 1].astype(np.float64))
        assert 0.1 < want.mean() < 0.9 and (got["like"] == want).mean() > 0.999
        assert np.allclose(got["explained"], twin.explained(costs[view - 1]), atol=1e-6, equal_nan=True)
        epipolar_offset = twin.least_at(costs[view - 1][[7, 8, 3, 9, 10]])
        below, right = (np.arange(n) * 2 >= n for n in shape)
        for k in range(4):                                 # by quadrant of the target
            inside = (below == k // 2)[:, None] & (right == k % 2)
            assert np.allclose(got[f"epipolar_offset {k}"], np.where(inside, epipolar_offset, np.nan), atol=1e-4,
                               equal_nan=True)
    cl.enqueue_fill_buffer(device.queue, probe.buffers.matches, np.uint32(0), 0, probe.buffers.matches.size)
    run_once(device.queue, probe._judge())
    rows = read(device, probe.samples.values, (3, *shape))
    for name, got, want in zip(("seen", "far", "specularity"), rows, twin.judged(scene.initial, totals, values[:, 9])):
        assert len(np.unique(want[np.isfinite(want)])) > 1 and np.isnan(want).any(), name
        assert np.isclose(got, want, atol=1e-6, equal_nan=True).mean() > 0.999, name


def test_matched_colours_and_the_fit_equal_the_twin(device, smooth_scene, smooth_probe):
    scene, probe = smooth_scene, smooth_probe
    for view in (1, 2):
        run_once(device.queue, [*nearest(probe, view), *probe.sample(probe.views[view - 1]), match(probe, view)])
    run_once(device.queue, probe._judge())
    matches = read(device, probe.buffers.matches, (2, *scene.initial.shape, 8))
    table, initial = read(device, probe.buffers.exposure, (3, 2, 3)), scene.initial.astype(np.float64)
    assert (table[0] == [[1] * 3, [0] * 3]).all()
    for number, context in enumerate(scene.contexts, start=1):
        got, rows = matches[number - 1], rows_of(device, probe, number)
        own, other, _ = exposure_twin.match(initial, scene.target, context, None, 0.0, scene.scene_scale)
        seen = got[..., 3] > 0
        assert seen.mean() > 0.1
        assert np.abs(got[..., :3] - own)[seen].max() < 1e-5
        assert np.quantile(np.abs(got[..., 4:7] - other)[seen], 0.99) < 1e-4
        usable = got[..., 3] == 2
        want = exposure_twin.fit(got[usable][:, :3], got[usable][:, 4:7])
        assert np.abs(table[number].T - want).max() < 2e-3
        assert np.allclose(rows["change g"][seen], (got[..., 5] - got[..., 1])[seen], atol=1e-6)
        left = twin.specularity(got[..., :3], got[..., 4:7], got[..., 3], rows["like"] == 1, table[number].T)
        assert (np.isnan(left) == np.isnan(rows["specularity"])).all() and np.isfinite(left).mean() > 0.05
        assert np.nanmax(np.abs(left - rows["specularity"])) < 1e-5


def test_states_of_matches_equal_the_twin(device, smooth_scene, smooth_probe):
    scene, probe = smooth_scene, smooth_probe
    """Without anything hidden: where the photo is seen, and where it is clipped."""
    scene, probe = smooth_scene, smooth_probe
    cl.enqueue_fill_buffer(device.queue, probe.buffers.z_first, np.float32(np.inf), 0, probe.buffers.z_first.size)
    run_once(device.queue, [match(probe, 1)])
    got = read(device, probe.buffers.matches, (2, *scene.initial.shape, 8))[0, ..., 3]
    want = exposure_twin.match(scene.initial.astype(np.float64), scene.target, scene.contexts[0], None, 0.0,
                               scene.scene_scale)[2]
    inner = np.s_[3:-3, 3:-3]
    assert (got[inner] == want[inner]).mean() > 0.99 and (np.unique(want) == [0, 1, 2]).all()


def test_summaries(device):
    rng = np.random.default_rng(0)
    values = np.stack([rng.normal(0.3, 0.05, 5000), rng.integers(0, 2, 5000), np.full(5000, np.nan),
                       rng.uniform(0, 1, 5000)])
    values[0, ::3] = np.nan
    rows = Rows(device, [(0, 1, 0.95), (0, 1, 0.5), (0, 1, 0.5), (0, 0.5, 0.25)], 5000)
    cl.enqueue_copy(device.queue, rows.values, values.astype(np.float32))
    run_once(device.queue, [rows.summarize()])
    got = rows.read()
    assert got[0] == pytest.approx(twin.summarize(values[0], 0.95), abs=1e-3)
    assert got[1, [0, 1, 3]] == pytest.approx(np.array(twin.summarize(values[1], 0.5))[[0, 1, 3]], abs=1e-6)
    assert got[2] == pytest.approx(twin.summarize(values[2], 0.5), nan_ok=True)
    # those beyond the range: in the last bin
    assert got[3] == pytest.approx(twin.summarize(values[3], 0.25), abs=1e-3)


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_noise_and_texture_equal_the_twin(device, noise):
    view = relief_scene(120, 90, 1, held_out=0, noise=noise).views[0]
    got = ImageNoise(device, PhotoStore(device).photo(view), Size(120, 90)).read()
    want = twin.noise_and_texture(view.load_image())
    assert got[0] == pytest.approx(want[0], abs=0.6 * 1.4826 / 6**0.5 / 765)    # a median of whole numbers
    assert got[1] == pytest.approx(want[1], abs=0.02)


@given(st.integers(1, 1 << 20), st.integers(1, 1 << 20))
def test_samples_fit_their_buffers_whatever_the_shape(width, height):
    grid = SampleGrid.over(Size(width, height))
    assert 1 <= grid.count <= 2 * MOST_SAMPLES
    assert (grid.across - 1) * grid.stride < width and (grid.down - 1) * grid.stride < height
