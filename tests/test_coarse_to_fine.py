"""Where a start is far off, all views are refined at smaller sizes first (method section 8.3)."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from support.scenes import relief_scene
from support.synthetic.scene import write_scene
from twins.carry_over import carry_over

from pagas_cl import InputError, View, preset, read_scene, refine_depth, refine_views
from pagas_cl.app.demo_scene import Look, make_scene
from pagas_cl.errors import DeviceError
from pagas_cl.method.splat import photos
from pagas_cl.method.splat.carry_over import follow
from pagas_cl.method.view import coarse_to_fine
from pagas_cl.method.view.coarse_to_fine import FAR_OFF, Movement, moved_along
from pagas_cl.runtime.memory import download, upload
from pagas_cl.scene.camera import Size
from pagas_cl.scene.lens import Lens, ThroughLens
from pagas_cl.scene.view import smaller

QUICK = preset("balanced").with_settings(pyramid__steps=(60,), effects__cameras="off", effects__hypotheses="off")
FEW = QUICK.with_settings(pyramid__steps=(16,))      # where how near they come is not the question


def with_pyramid(choice, config=QUICK):
    return replace(config, effects=replace(config.effects, pyramid=choice))


def scene(**settings):
    """A made scene of 160 x 120 and four views, and its initial depth maps."""
    made = relief_scene(160, 120, 3, held_out=0, steps=0, **settings)
    return made, [made.initial_depth(camera) for camera in made.cameras]


def error(made, results):
    """Mean, in pixels of parallax."""
    truth = [made.true_depth(camera) for camera in made.cameras]
    return float(np.mean([np.abs(result.depth - true)[true > 0].mean() for result, true in zip(results, truth)])
                 / made.relief.parallax)


def decision_of(result):
    return next(effect for effect in result.report["effects"] if effect["effect"] == "pyramid")


@pytest.mark.parametrize("name, left", (("balanced", 0.3), ("fast", 0.4)))     # "fast" has one smaller size
def test_a_far_start_is_reached_from_smaller_sizes(name, left):
    made, depths = scene(coarse_error=4.0)
    config = replace(preset(name), effects=replace(preset(name).effects, cameras="off"))
    alone, auto = (refine_views(made.views, depths, config=with_pyramid(choice, config)) for choice in ("off", "auto"))
    assert error(made, auto) < left * error(made, alone)
    assert decision_of(auto[0])["on"] and decision_of(auto[0])["evidence"] > FAR_OFF
    assert not decision_of(alone[0])["on"]


def test_a_near_start_is_measured_and_not_touched():
    made, depths = scene()
    off, auto = (refine_views(made.views, depths, config=with_pyramid(choice, FEW)) for choice in ("off", "auto"))
    assert decision_of(auto[0])["evidence"] < FAR_OFF / 2
    assert all(np.array_equal(one.depth, other.depth) for one, other in zip(off, auto))


def test_one_view_by_itself_goes_the_same_way():
    made, depths = scene(coarse_error=4.0)
    alone, auto = (refine_depth(made.views[0], made.views[1:], depths[0], config=with_pyramid(choice))
                   for choice in ("off", "auto"))
    truth = made.true_depth(made.cameras[0])
    assert np.abs(auto.depth - truth).mean() < 0.5 * np.abs(alone.depth - truth).mean()
    assert decision_of(auto)["on"]


def test_starts_that_a_device_has_no_room_to_compare_are_those_of_smaller_sizes(monkeypatch):
    def no_room(*_):
        raise cl.MemoryError(cl._cl._ErrorRecord("create_buffer", -4, ""))

    made, depths = scene(coarse_error=4.0)
    monkeypatch.setattr(coarse_to_fine, "better_start", no_room)
    found = refine_depth(made.views[0], made.views[1:], depths[0], config=with_pyramid("on"))
    truth = made.true_depth(made.cameras[0])
    assert np.abs(found.depth - truth).mean() < 0.5 * np.abs(depths[0] - truth).mean()


def test_a_run_in_a_folder_gives_the_same_bytes_and_goes_on(tmp_path):
    made, depths = scene(coarse_error=4.0)
    config = with_pyramid("on").with_settings(pyramid__steps=(8,))
    here = refine_views(made.views, depths, config=config)
    for _ in range(2):
        kept = refine_views(made.views, depths, config=config, folder=tmp_path)
        assert all(np.array_equal(one.depth, other.depth) for one, other in zip(here, kept))
    assert (tmp_path / ".pagas_cl" / "size_2").is_dir()


def test_photos_are_read_once_a_size(tmp_path, monkeypatch):
    """On a GPU, for all rounds and passes: those of the next size meanwhile."""
    made, depths = scene(coarse_error=4.0)
    views, read, sizes = read_scene(write_scene(made, tmp_path / "scene")).views, photos._read, []
    monkeypatch.setattr(photos, "_read", lambda view: sizes.append(view.camera.width) or read(view))
    monkeypatch.setattr(photos.PhotoStore, "on_host", property(lambda _: False, lambda *_: None), raising=False)
    for folder in (None, tmp_path / "kept"):
        sizes.clear()
        refine_views(views, depths, config=with_pyramid("auto").with_settings(pyramid__steps=(8,)), folder=folder)
        assert len(set(sizes)) == 3 and all(sizes.count(size) == len(views) for size in sizes)


@pytest.mark.parametrize("gains_little", (False, True))
@pytest.mark.parametrize("names", (None, ["target.png"]))
def test_only_what_full_size_needs_is_kept_to_the_end(tmp_path, monkeypatch, names, gains_little):
    """Not photos of smaller sizes, some of which nobody has used, nor the depth maps of rounds."""
    made, depths = scene(coarse_error=4.0)
    views, kept = read_scene(write_scene(made, tmp_path / "scene")).views, []
    monkeypatch.setattr(photos.PhotoStore, "on_host", property(lambda _: False, lambda *_: None), raising=False)
    monkeypatch.setattr(photos.PhotoStore, "clear", lambda store: kept.extend([*store._held, *store._ahead]))
    monkeypatch.setattr(coarse_to_fine, "_gains_little", lambda *_: gains_little)
    config = with_pyramid("on").with_settings(pyramid__steps=(8,), pyramid__far_off=(0.5, 0.25))
    refine_views(views, depths, names=names, config=config)
    assert kept and {type(owner) for owner in kept} == {View} and {owner.camera.width for owner in kept} == {160}


@pytest.mark.parametrize("choice", ("auto", "on", "off"))
def test_a_photo_that_cannot_be_read_is_told_as_ever(choice, tmp_path):
    made, depths = scene(coarse_error=4.0)
    (tmp_path / "broken.png").write_bytes(b"no photo")
    views = [*made.views[:3], replace(made.views[3], image=tmp_path / "broken.png")]
    with pytest.raises(InputError, match="every view has failed; .*broken.png' cannot be read"):
        refine_views(views, depths, config=with_pyramid(choice))


def test_what_smaller_sizes_leave_is_not_told_as_the_end(caplog, recwarn):
    """Photos of noise: every size refuses, and the full one alone says so."""
    made, depths = scene()
    noise = np.random.default_rng(0)
    views = [replace(view, image=noise.integers(0, 255, (120, 160, 3), dtype=np.uint8)) for view in made.views]
    results = refine_views(views, depths, config=with_pyramid("on", FEW))
    refused = [result for result in results if result.reason]
    assert len(refused) == caplog.text.count("stays unchanged") > 0
    assert len([warning for warning in recwarn if "nothing was refined" in str(warning.message)]) <= 1


@pytest.mark.parametrize("kept", (False, True))
def test_a_refused_view_that_smaller_sizes_have_moved_is_named(caplog, tmp_path, kept):
    """Photos in another order than the cameras: what is returned is not what was given, so "unchanged" is not all."""
    made, depths = scene()
    views = [replace(view, image=other.image) for view, other in zip(made.views, made.views[::-1])]
    results = refine_views(views, depths, config=with_pyramid("on", FEW), folder=tmp_path if kept else None)
    moved = [result.name for result, depth in zip(results, depths)
             if result.reason and not np.array_equal(result.depth, depth)]
    assert moved and f"unchanged at full size {len(moved)} have the depth that smaller sizes have left" in caplog.text
    assert all(name in caplog.messages[-1] for name in moved)
    caplog.clear()
    for result, depth in zip(refine_views(views, depths, config=with_pyramid("off", FEW)), depths):
        assert np.array_equal(result.depth, depth) and result.reason
    assert "smaller sizes" not in caplog.text


def test_smaller_sizes_that_gain_nothing_are_given_up(monkeypatch, device, tmp_path):
    """Where a near start is measured as one that is far off: the same depth maps as without them, and it is said."""
    made = relief_scene(160, 120, 7, held_out=0, steps=0)
    depths = [0.6 * made.true_depth(camera) + 0.4 * made.initial_depth(camera) for camera in made.cameras]
    monkeypatch.setattr(coarse_to_fine, "far_off", lambda *_: 0.1)
    expected = refine_views(made.views, depths, config=with_pyramid("off", FEW), device=device)
    for folder in (None, tmp_path / "kept"):
        shown = []      # on a page, while the run goes on
        found = refine_views(made.views, depths, config=with_pyramid("auto", FEW), device=device, folder=folder,
                             on_view=lambda view, _, result: shown.append(dict(decision_of(result))))
        assert shown == [decision_of(result) for result in found]
        for one, other in zip(found, expected):
            assert np.array_equal(one.depth, other.depth) and "smaller_sizes" not in one.report
            effect, = (effect for effect in one.report["effects"] if effect["effect"] == "pyramid")
            assert not effect["on"] and "given up" in effect["reason"]


@pytest.mark.parametrize("costs, given_up", [([(0.4, np.nan)], False), ([(np.nan, 0.4), (0.4, np.nan)], False),
                                             ([(0.4, np.nan), (0.4, 0.4)], True), ([(0.4, np.nan), (0.4, 0.1)], False)])
@pytest.mark.filterwarnings("error")
def test_a_photo_that_sees_nothing_of_a_size_says_nothing_of_its_gain(costs, given_up):
    result = SimpleNamespace(reason="", report={"held_out_costs": costs})
    assert coarse_to_fine._gains_little([result], SimpleNamespace(evidence=0.1)) is given_up


def test_without_a_device_no_size_is_begun():
    made, depths = scene()

    def no_device():
        raise DeviceError("no device")

    with pytest.raises(DeviceError, match="no device"):
        coarse_to_fine.through_sizes(lambda *_: pytest.fail("a size was refined"), made.views, depths, [0],
                                     with_pyramid("on"), no_device)
    starts = coarse_to_fine.through_sizes(None, made.views, depths, [0], with_pyramid("set"), no_device)
    assert starts.depths == depths and starts.decision is None


def test_photos_too_small_for_the_sizes_are_said(device):
    made, depths = scene()
    small = with_pyramid("on").with_settings(pyramid__far_off=(0.125,))
    found = refine_views(made.views, depths, config=small, device=device)
    effect, = (effect for effect in found[0].report["effects"] if effect["effect"] == "pyramid")
    assert not effect["on"] and "photos are too small" in effect["reason"]


def moved(device, depth, share, scale=0.5):
    """`depth` moved along with a result of half the size in which all of it has moved by `share`, pixels of parallax
    at that size; a pixel of parallax is 0.1 there."""
    start = depth[::2, ::2].copy()
    result = SimpleNamespace(depth=start + np.float32(0.1 * share), parallax=np.full_like(start, 0.1),
                             deviation=np.full_like(start, 0.01))
    return moved_along(depth, Movement(start, result, scale), device)


def test_what_moved_far_is_carried_over_and_what_moved_little_stays(device):
    depth = np.full((12, 16), 5.0, np.float32)
    assert moved(device, depth, 3.0) == pytest.approx(5.3, rel=1e-6)
    assert np.array_equal(moved(device, depth, 0.2), depth)          # 0.4 pixels at full size


def test_another_surface_does_not_move_along(device):
    depth = np.full((12, 16), 5.0, np.float32)
    depth[5:7, 5:7] = 3.0           # between the pixels of the smaller size: none of them is of it
    start = np.full((6, 8), 5.0, np.float32)
    result = SimpleNamespace(depth=start + 0.3, parallax=np.full_like(start, 0.1),
                             deviation=np.full_like(start, 0.01))
    out = moved_along(depth, Movement(start, result, 0.5), device)
    assert (out[5:7, 5:7] == 3).all() and out[0, 0] == pytest.approx(5.3)


def test_what_is_unsure_next_to_an_edge_moves_as_its_surface_does(device):
    """Single depths go astray where a smaller photo shows both sides: those around them, which are sure, did not."""
    depth = np.full((24, 32), 5.0, np.float32)
    depth[:, 16:] = 3.0
    start = depth[::2, ::2].copy()
    result = SimpleNamespace(depth=start.copy(), parallax=np.full_like(start, 0.1), deviation=np.full_like(start, 0.01))
    result.depth[:, 7], result.deviation[:, 7] = 5.3, 0.2           # three pixels of parallax
    result.depth[:, 9:], result.deviation[:, 8] = 3.3, np.inf       # the other side moves, but for its edge
    out = moved_along(depth, Movement(start, result, 0.5), device)
    assert np.array_equal(out[:, :16], depth[:, :16])
    assert out[:, 16:] == pytest.approx(3.3, rel=2e-3)


@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e6])
def test_depths_are_carried_over_as_by_the_twin(device, unit):
    """Surfaces with steps, holes and a bar, half of which is found on what is next to it; sizes that are no multiples
    of one another, deviations that are not known."""
    rng = np.random.default_rng(3)
    given, depth = (steps(shape, rng) for shape in ((13, 19), (37, 50)))
    parallax = rng.uniform(0.05, 0.15, given.shape)
    found = np.where(given > 0, given + parallax * rng.uniform(-3, 3, given.shape), 0)
    found = np.where((given == BAR) & (rng.random(given.shape) < 0.5), np.roll(given, 1, axis=0), found)
    deviation = np.where(rng.random(given.shape) < 0.2, np.inf, parallax * rng.uniform(0.01, 1, given.shape))
    given, found, parallax, deviation, depth = (np.float32(unit * one) for one in (given, found, parallax, deviation,
                                                                                   depth))
    result = SimpleNamespace(depth=found, parallax=parallax, deviation=deviation)
    expected = carry_over(depth, given, found, parallax, deviation, 0.37)
    assert np.abs(expected - depth).max() > 0.1 * unit
    assert moved_along(depth, Movement(given, result, 0.37), device) == pytest.approx(expected, rel=2e-6)


BAR = 4.0


def steps(shape, rng):
    """Depths of two surfaces and a thin bar between them, some pixels without."""
    row, column = np.mgrid[:1:shape[0] * 1j, :1:shape[1] * 1j]
    surfaces = np.where(row + column > 1, 5.0, 3.0) + 0.04 * column
    return np.where(rng.random(shape) < 0.1, 0.0, np.where(np.abs(row - 0.5) < 0.06, BAR, surfaces))


def test_a_level_is_carried_over_however_little_it_moved(device):
    rng = np.random.default_rng(1)
    depth, given = (rng.uniform(3, 3.2, shape).astype(np.float32) for shape in ((30, 41), (15, 20)))
    found = (given * rng.uniform(0.99, 1.01, given.shape)).astype(np.float32)
    parallax = np.full(given.shape, 0.1, np.float32)
    expected = carry_over(depth, given, found, parallax, np.zeros_like(given), 0.0)
    moved = upload(device, depth)
    buffers = [upload(device, one) for one in (given, found, parallax)]
    follow(device, Size(20, 15), 0.0, *buffers).carry_over(device, moved, Size(41, 30))
    np.testing.assert_allclose(download(device, moved, depth.shape), expected, rtol=2e-6)
    assert (expected != depth).mean() > 0.9


def test_a_thin_thing_stays_through_a_level_of_half_the_size(device):
    """Which noisy photos have: a bar four pixels wide was enlarged from two, together with what is behind it."""
    made = make_scene(144, 108, 4, device, Look(bar=4.0))
    true, start = made.true[0], made.true[0] + np.float32(0.5 * made.parallax)
    bar = make_scene(144, 108, 1, device, Look()).true[0] - true > 5 * made.parallax
    few = preset("balanced").with_settings(effects__pyramid="off", effects__hypotheses="off", effects__noise="on")
    errors = {}
    for carried in (True, False):
        result = refine_depth(made.views[0], made.views[1:-1], start, device=device,
                              config=few.with_settings(pyramid__carry_over=carried))
        assert len(result.report["steps"]) == 2
        errors[carried] = [np.median(np.abs(result.depth - true)[where]) / made.parallax for where in (bar, ~bar)]
    assert bar.sum() > 150 and errors[True][0] < 0.1 and errors[True][1] < 0.03
    assert errors[False][0] > 0.4


def test_a_smaller_view_shrinks_its_photo_and_its_mask():
    made, _ = scene()
    mask = np.zeros((120, 160), bool)
    mask[:, 81:] = True
    view = View(made.views[0].camera, made.views[0].load_image(), mask, "one")
    small = smaller(view, 0.25)
    assert small.load_image().shape == (30, 40, 3) and small.camera.fx == pytest.approx(view.camera.fx / 4)
    assert small.load_mask()[:, 20:].all() and not small.load_mask()[:, :20].any()
    again, other = smaller(view, 0.25), smaller(view, 0.5)
    assert small.image.digest == again.image.digest != other.image.digest != small.mask.digest


def test_a_smaller_photo_behind_a_lens_is_known_by_what_its_file_holds(tmp_path):
    made, _ = scene()
    path, found = tmp_path / "one.png", []
    lens = Lens("PINHOLE", (), (160, 120), (160, 120, 100.0, 100.0, 80.0, 60.0))
    for content in (b"one photo", b"another photo"):
        path.write_bytes(content)
        found.append(smaller(replace(made.views[0], image=ThroughLens(path, lens)), 0.5).image.digest)
    assert found[0] != found[1]
