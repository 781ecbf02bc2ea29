"""Depth maps that disagree are aligned in scale: unit, a factor and a shift a view, the factor of all."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.camera_noise import noisy
from support.example_scenes import as_network, frames_of
from support.scenes import relief_scene

from pagas_cl.errors import InputError
from pagas_cl.method.surface import common_scale, depth_alignment
from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.method.surface.common_scale import find_common_scale
from pagas_cl.method.surface.depth_alignment import Overlaps
from pagas_cl.method.surface.photo_sweep import Greys
from pagas_cl.scene.check.reasons import mesh_of_depths
from pagas_cl.scene.depth.source import Adjusted
from pagas_cl.scene.depthmap import stretched_depth
from pagas_cl.scene.images import bilinear

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(200, 150, 2, held_out=0)


@pytest.fixture(scope="module")
def coarse(made):
    return [made.initial_depth(view.camera) for view in made.views]


@pytest.fixture(scope="module")
def networks(made):
    return [frame.depth for frame in as_network(frames_of(made, 1.0))]


@pytest.fixture(scope="module")
def of_networks(made, networks):
    return align_depth_scales(made.views, networks)


def with_holes(coarse, nothing):
    """Depth maps that disagree by factors, with `nothing` in the same part of each."""
    depths = [np.float64(scale) * depth for scale, depth in zip((1.1, 0.9, 1.2), coarse)]
    for depth in depths:
        depth[:30, :40] = nothing
    return depths


@pytest.fixture(scope="module")
def of_holed(made, coarse):
    return align_depth_scales(made.views, with_holes(coarse, 0), True)


@pytest.fixture(scope="module")
def frames():
    """Views of a larger scene, and what belongs to them."""
    made = relief_scene(252, 190, 3, held_out=0)
    frames = frames_of(made)
    return [replace(view, camera=frame.camera) for view, frame in zip(made.views, frames)], frames


def error(depths, made):
    """Mean, in pixels of parallax."""
    truth = [made.true_depth(view.camera) for view in made.views]
    return np.mean([np.abs(d - t)[(d > 0) & (t > 0)].mean() for d, t in zip(depths, truth)]) / made.relief.parallax


def test_factors_and_shifts():
    made = relief_scene(200, 150, 3, held_out=0)
    networks = [frame.depth for frame in as_network(frames_of(made, 1.0))]
    found = align_depth_scales(made.views, networks)
    assert error(networks, made) > 5 > 0.5 > error(found.apply(networks), made)
    assert found.unit == 1 and found.disagreement[0] > 0.05 > 0.01 > found.disagreement[1]
    assert "disagreed by" in found.said[0] and "all depths are multiplied by" in found.said[-1]
    again = align_depth_scales(made.views, networks)
    assert again.factors.tobytes() == found.factors.tobytes() and again.shifts.tobytes() == found.shifts.tobytes()


@pytest.mark.parametrize("nothing", [np.inf, np.nan, -1.0, np.finfo(np.float64).max])
def test_what_is_no_surface_takes_no_part(made, coarse, of_holed, nothing):
    """Infinity, as ray casting and some networks leave it, took all that lies behind it along: nothing was aligned."""
    expected, marked = of_holed, with_holes(coarse, nothing)
    given = [depth.copy() for depth in marked]
    found = align_depth_scales(made.views, marked, True)
    assert expected.disagreement[0] > 0.05 > 0.01 > expected.disagreement[1]
    assert found.factors.tobytes() == expected.factors.tobytes()
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(marked, given)), "the caller's stay as they are"


def test_depth_maps_that_agree_stay_the_same_objects(made, coarse):
    found = align_depth_scales(made.views, coarse)
    assert all(a is b for a, b in zip(found.apply(coarse), coarse)) and found.said == ()


@pytest.mark.parametrize("what, values_of", [
    ("distances along rays", lambda depth, camera: depth * np.linalg.norm(camera.rays(), axis=-1)),
    ("inverse depth", lambda depth, camera: 1 / depth), ("rows from the bottom", lambda depth, camera: depth[::-1])])
def test_maps_that_hold_something_else_are_named(frames, what, values_of):
    """A factor and a shift made distances along rays agree by half: all was refined from them, and bent."""
    views, frames = frames
    said = align_depth_scales(views, [values_of(f.depth, f.camera).astype(np.float32) for f in frames]).said
    assert f"depth maps hold {what}" in said[-1] and "photos agree 0.9" in said[-1]


def test_of_maps_that_hold_depth_nothing_is_said(frames):
    views, frames = frames
    assert align_depth_scales(views, [f.depth for f in frames]).said == ()


@pytest.mark.parametrize("none", [np.inf, np.nan])
def test_no_surface_may_be_infinity_or_nan(made, networks, of_networks, none):
    """MoGe writes infinity: factors of two views were 1, and those of others wrong, without a word."""
    assert all((depth == 0).any() for depth in networks)
    found = align_depth_scales(made.views, [np.where(depth > 0, depth, np.float32(none)) for depth in networks])
    assert found.factors.tobytes() == of_networks.factors.tobytes()


def test_the_factor_of_all_where_cameras_are_off():
    made, errors = relief_scene(200, 150, 3, held_out=0), []
    coarse = [made.initial_depth(view.camera) for view in made.views]
    for seed in (1, 3):
        cameras = noisy(made.cameras, 2.0, seed)
        views = [replace(view, camera=camera) for view, camera in zip(made.views, cameras)]
        found = find_common_scale(Greys(views), [depth * np.float32(1.05) for depth in coarse])
        middle = np.median(coarse[0])
        errors.append(found.factor * 1.05 + found.shift / middle - 1)
    assert np.sqrt(np.mean(np.square(errors))) < 0.018        # 0.0225 where the mean correlation of all is best


@pytest.mark.parametrize("unit", [1000, 0.001])
def test_units_are_found_and_said(made, coarse, unit):
    found = align_depth_scales(made.views, [depth * np.float32(unit) for depth in coarse])
    assert found.unit == unit and f"{unit:g} times as large" in found.said[0] and "metre" in found.said[0]
    assert error(found.apply([depth * np.float32(unit) for depth in coarse]), made) < 0.4
    assert align_depth_scales(made.views, [d * np.float32(unit) for d in coarse], unit_is_known=True).unit == 1


def test_views_without_depth_and_result_are_free_of_scene_units(made, networks):
    some = [None, *networks[1:]]
    found = align_depth_scales(made.views, some)
    assert found.apply(some)[0] is None and found.factors[0] == 1
    alone = [networks[0], None, None]       # photos say the factor of a single map
    assert error(align_depth_scales(made.views, alone).apply(alone)[:1], made) < 0.5 < 2 < error(alone[:1], made)
    assert align_depth_scales(made.views, [None] * 3).said == ()
    x, y = (depth_alignment.solve(Overlaps.of(_reduced(made, networks, scale))) for scale in (1.0, 1e-4))
    assert np.abs(x - y).max() < 1e-6


def test_pairs_next_to_one_another_are_compared_as_each_by_itself(made, coarse):
    """Maps of three sizes, with different numbers of samples: each sample is carried and looked up in its own."""
    sizes = [(64, 48), (80, 60), (40, 60)]
    views = [depth_alignment.reduced(view.camera.resized(*size), stretched_depth(depth, *size)) for view, depth, size in
             zip(made.views, coarse, sizes)]
    maps, x = Overlaps.of(views), np.array([[0.1, 0.02], [-0.05, 0.01], [0.0, -0.03]])
    assert len({len(view.samples) for view in views}) > 1 and len(maps.pairs) >= 4
    found, given = maps.residuals(x)
    for pair, r, other in zip(maps.pairs, found, given):
        i, j = (views[k] for k in pair)
        (a, b), (c, d) = x[pair] * [[1, i.middle], [1, j.middle]]
        rotation, tau = j.camera.relative_to(i.camera)
        at = (i.rays * (np.exp(a) * i.samples + b)[:, None]) @ rotation.T + tau
        u, v = at[:, 0] / at[:, 2] * j.camera.fx + j.camera.cx, at[:, 1] / at[:, 2] * j.camera.fy + j.camera.cy
        known = np.flatnonzero(np.isfinite(r[:len(i.samples)]))
        assert len(known) > 50 and not np.isfinite(r[len(i.samples):]).any()
        seen = bilinear(j.depth.astype(np.float64), u[known], v[known])
        assert other[known] == pytest.approx(seen, rel=1e-12)
        assert r[known] == pytest.approx(np.log(at[known, 2] / (np.exp(c) * seen + d)), abs=1e-12)


def test_one_depth_map_a_view(made, coarse):
    for depths, sentence in ((coarse[1:], "2 depth maps were given for 3 views"),
                             ([depth[..., None] for depth in coarse], r"depths\[0\], .*has shape \(150, 200, 1\)")):
        with pytest.raises(InputError, match=sentence):
            align_depth_scales(made.views, depths)
    with pytest.raises(InputError, match="2 depth maps were given for 3 views, expected one each"):
        align_depth_scales(made.views, [None] * 3).apply(coarse[1:])


def test_maps_of_one_sample_say_nothing(made, coarse):
    few = [np.where(np.arange(depth.size).reshape(depth.shape) == depth.size // 2, depth, 0) for depth in coarse]
    found = align_depth_scales(made.views, few)
    assert (found.factors == 1).all() and found.disagreement == (0.0, 0.0)


def _reduced(made, depths, scale):
    views = []
    for view, depth in zip(made.views, depths):
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] *= scale
        views.append(depth_alignment.reduced(replace(view.camera, world_to_camera=pose), depth * np.float32(scale)))
    return views


@pytest.mark.parametrize("pixels, message", [(2, "miss one another by about [1-6].* pixels"), (60, "paired wrongly")])
def test_cameras_that_are_off_are_said(made, coarse, pixels, message):
    off = []
    for k, view in enumerate(made.views):
        pose = view.camera.world_to_camera.copy()
        pose[:2, 3] += np.array([(-1) ** k, (-1) ** (k // 2)]) * pixels * made.relief.footprint
        off.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    found = align_depth_scales(off, coarse)
    assert re.search(message, found.said[-1]) and "bundle" in found.said[-1]


@pytest.mark.parametrize("factor, numbers", [(1.0, {6}), (1.03, {6, 24})])
def test_a_few_pairs_say_whether_all_are_compared(monkeypatch, factor, numbers):
    made, number = relief_scene(96, 72, 9, held_out=0), []
    make = common_scale.Sweep
    monkeypatch.setattr(common_scale, "Sweep", lambda greys, depths, pairs, *more: (
        number.append(len(pairs)), make(greys, depths, pairs, *more))[1])
    depths = [made.initial_depth(view.camera) * np.float32(factor) for view in made.views]
    found = find_common_scale(Greys(made.views), depths)
    wrong = found.factor * factor + found.shift * factor / np.median(depths[0]) - 1
    assert abs(wrong) < 1e-3 and set(number) == numbers


def test_adjusted_depth_is_a_file_still(coarse):
    class File:
        digest = "a"

        def load(self):
            return coarse[0]

    moved = Adjusted(File(), 2.0, -1.0)
    assert np.allclose(moved.load(), 2 * coarse[0] - 1) and moved.digest != Adjusted(File(), 2.0, 1.0).digest


def test_mesh_of_depths_lies_on_them(made, coarse):
    surface = mesh_of_depths([view.camera for view in made.views], coarse)
    uv, z = made.views[0].camera.project(surface.vertices)
    inside = (uv >= 0).all(axis=1) & (uv < (200, 150)).all(axis=1)
    column, row = uv[inside].astype(int).T
    assert np.median(np.abs(z[inside] / coarse[0][row, column] - 1)) < 2e-3
