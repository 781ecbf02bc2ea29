"""Refinement of cameras: made scenes with cameras turned and moved at random, gauge, hard cases, the effect."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.camera_noise import after_similarity, noisy, rms_motion
from support.scenes import mixed_scene

import pagas_cl
from pagas_cl.config import Context
from pagas_cl.errors import InputError
from pagas_cl.method.cameras.effect import decide_cameras, resolve_cameras
from pagas_cl.method.cameras.motion import exponential, moved, pixel_motion, placed, register_to_mesh, twist_between
from pagas_cl.method.cameras.pairs import choose_pairs
from pagas_cl.method.cameras.refine import CLEARLY_OFF, OFF, refine_cameras
from pagas_cl.scene.view import View

pytestmark = pytest.mark.slow


class Case:
    """A made scene: true cameras and initial depth maps, and its views with other cameras."""

    def __init__(self, width=194, height=145, **settings):
        self.scene = mixed_scene(width, height, **{"contexts": 6, "held_out": 0, **settings})
        self.views = self.scene.all_views
        self.cameras = [view.camera for view in self.views]
        self.depths = [self.scene.initial_depth(camera) for camera in self.cameras]

    def through(self, cameras):
        return [View(camera, view.image, view.mask, view.name) for camera, view in zip(cameras, self.views)]

    def error(self, cameras) -> float:
        """Pixels off, after the similarity that no photo sees."""
        return rms_motion(self.cameras, after_similarity(cameras, self.cameras), self.depths)


@pytest.fixture(scope="module")
def relief():
    return Case()


@pytest.fixture(scope="module")
def off_by_one(relief, device):
    cameras = noisy(relief.cameras, 1.0, 0)
    return cameras, refine_cameras(relief.through(cameras), relief.depths, device=device)


@pytest.fixture(scope="module")
def small():
    """Where how near cameras come to the true ones is not the question."""
    return Case(120, 90)


@pytest.fixture(scope="module")
def small_off(small, device):
    cameras = noisy(small.cameras, 1.0, 0)
    return cameras, refine_cameras(small.through(cameras), small.depths, device=device)


def test_one_pixel(relief, off_by_one):
    cameras, found = off_by_one
    assert found.accepted and not found.left_out and found.reason == ""
    assert relief.error(cameras) > 0.5 and relief.error(found.cameras) < 0.06
    assert 0.5 < np.median(found.moved) < 2
    assert all(after < 0.3 * before for *_, before, after in found.pairs) and len(found.pairs) == 3
    assert found.report["cost_after"] < 0.1 * found.report["cost_before"]
    assert "are corrected: by" in str(found) and found.as_dict()["accepted"]
    # the surface stays as large as it was given
    scale = np.mean([np.linalg.norm(a.center - b.center) / np.linalg.norm(c.center - d.center) for a, c in
                     zip(found.cameras, relief.cameras) for b, d in zip(found.cameras, relief.cameras) if a is not b])
    assert scale == pytest.approx(1, abs=1e-3)


def test_four_pixels_coarse_to_fine(relief, device):
    cameras = noisy(relief.cameras, 4.0, 1)
    found = refine_cameras(relief.through(cameras), relief.depths, device=device)
    assert found.accepted and found.report["coarse"] and relief.error(found.cameras) < 0.08


def test_nothing_moves_where_nothing_is_off(relief, device):
    views = relief.through(relief.cameras)
    found = refine_cameras(views, relief.depths, device=device)
    assert np.max(found.moved) < 0.03 and not found.accepted and "agree clearly better" in found.reason
    assert all(a is b for a, b in zip(found.cameras, relief.cameras))
    same, config, found = resolve_cameras(views, relief.depths, pagas_cl.preset("balanced"), device)
    assert found is None and all(a is b for a, b in zip(same, views)) and config.effects.cameras == "set"


@pytest.mark.parametrize("pixels, gains", [(0.1, True), (0.0, False)])
def test_where_photos_are_off_by_little_pairs_that_take_no_part_decide(pixels, gains, relief, device):
    """At half of the size first: the rest is done where they promise something."""
    cameras = noisy(relief.cameras, pixels, 0)
    views = relief.through(cameras)
    config = pagas_cl.preset("balanced")
    _, (off, far_off) = decide_cameras(views, relief.depths, config, device)
    assert OFF < off < CLEARLY_OFF if gains else off < OFF
    found = refine_cameras(views, relief.depths, measured=(max(off, OFF), far_off), device=device)
    assert found.accepted == gains and ("at half of the size" in found.reason) != gains
    assert relief.error(found.cameras) < 0.6 * relief.error(cameras) if gains else not found.report.get("rounds")
    assert (resolve_cameras(views, relief.depths, config, device)[2] is not None) == gains


def test_it_is_a_warning_that_cameras_are_too_far_off(small, device, caplog):
    views = small.through(noisy(small.cameras, 60.0, 0))
    found = resolve_cameras(views, small.depths, pagas_cl.preset("balanced"), device)[2]
    assert not found.accepted and "run a bundle adjustment" in found.reason
    assert [record.levelname for record in caplog.records if "cameras stay unchanged" in record.message] == ["WARNING"]


def test_a_second_round_stays(relief, off_by_one, device):
    cameras, first = off_by_one
    again = refine_cameras(relief.through(first.cameras), relief.depths, gauge=cameras, device=device)
    assert np.max(again.moved) < 0.05


def test_same_bytes_twice_in_any_unit_and_place(small, small_off, device):
    cameras, found = small_off
    again = refine_cameras(small.through(cameras), small.depths, device=device)
    assert all(np.array_equal(a.world_to_camera, b.world_to_camera) for a, b in zip(found.cameras, again.cameras))
    far = [placed(c, c.world_to_camera[:3, :3], 1e-3 * c.center + 5e5) for c in cameras]
    other = refine_cameras(small.through(far), [d * np.float32(1e-3) for d in small.depths], device=device)
    back = [placed(c, c.world_to_camera[:3, :3], 1e3 * (c.center - 5e5)) for c in other.cameras]
    assert rms_motion(found.cameras, back, small.depths) < 0.01


def test_one_wrong_camera_is_named_and_left_out(relief, device):
    cameras = noisy(relief.cameras, 0.5, 2)
    cameras[2] = moved(cameras[2], [0, 30 / cameras[2].fx, 0, 0, 0, 0])
    found = refine_cameras(relief.through(cameras), relief.depths, device=device)
    assert found.left_out == ("context_01",) and found.cameras[2] is cameras[2]
    rest = [k for k in range(7) if k != 2]
    kept, true, depths = ([those[k] for k in rest] for those in (found.cameras, relief.cameras, relief.depths))
    assert found.accepted and rms_motion(true, after_similarity(kept, true), depths) < 0.1
    assert "context_01" in str(found)


@pytest.mark.parametrize("settings, most", [
    (dict(exposure=0.3, foreground=True, noise=3.0), 0.2), (dict(zooms=(1.0, 1.4, 0.8), sizes=(1.0, 1.3)), 0.35),
    (dict(base=0.0, detail=0.0, steps=0), 0.2)], ids=["masks, exposure, noise", "mixed", "plane"])
def test_hard_scenes(settings, most, device):
    case = Case(120, 90, **settings)
    cameras = noisy(case.cameras, 1.0, 0)
    found = refine_cameras(case.through(cameras), case.depths, device=device)
    assert found.accepted and case.error(found.cameras) < most < case.error(cameras)


def test_something_that_moves_in_the_middle(relief, device):
    patch = np.random.default_rng(1).integers(0, 255, (15, 20, 3), np.uint8).repeat(3, 0).repeat(3, 1)
    views = []
    for k, (view, camera) in enumerate(zip(relief.views, noisy(relief.cameras, 1.0, 0))):
        photo = view.load_image().copy()
        photo[50:95, 50 + 9 * k:110 + 9 * k] = patch
        views.append(View(camera, photo, name=view.name))
    found = refine_cameras(views, relief.depths, device=device)
    assert found.accepted and relief.error(found.cameras) < 0.15


def test_what_cannot_be_measured_stays_with_a_reason(relief, device):
    two = refine_cameras(relief.through(relief.cameras)[:2], relief.depths[:2], device=device)
    assert not two.accepted and "four views" in two.reason and "stay unchanged" in str(two)
    turned = [placed(c, relief.cameras[0].world_to_camera[:3, :3], relief.cameras[0].center) for c in relief.cameras]
    alone = refine_cameras(relief.through(turned), relief.depths, device=device)
    assert not alone.accepted and "four views" in alone.reason
    blank = [replace(view, image=np.full((145, 194, 3), 128, np.uint8)) for view in relief.views]
    empty = refine_cameras(blank, relief.depths, device=device)
    assert not empty.accepted and np.nanmax(empty.moved) < 0.03
    for nothing in ([None] * 7, np.zeros((7, 145, 194))):
        none = refine_cameras(relief.views, nothing, unknowns="pose", device=device)
        assert not none.accepted and "no view has a surface" in none.reason
    with pytest.raises(InputError, match="lenses has 1 numbers, expected one for each of the 7 views"):
        refine_cameras(relief.views, relief.depths, unknowns=("focal",), lenses=[0], device=device)
    with pytest.raises(InputError, match="views is None, expected a list of pagas_cl.View"):
        refine_cameras(None, relief.depths, device=device)
    with pytest.raises(InputError, match="unknowns has 'shape'"):
        refine_cameras(relief.views, relief.depths, unknowns=("shape",), device=device)
    with pytest.raises(InputError, match="3 depth maps were given for 7 views"):
        refine_cameras(relief.views, relief.depths[:3], device=device)


@pytest.mark.filterwarnings("ignore:nothing was refined")      # with cameras as given
def test_the_effect_moves_cameras_before_views_are_refined(small, small_off, device):
    from pagas_cl.refine import refine_views

    cameras, found = small_off
    config = pagas_cl.preset("balanced").with_settings(pyramid__steps=(16,))
    views, names = small.through(cameras), [small.views[0].name]
    result, = refine_views(views, small.depths, names=names, config=config, device=device)
    assert np.array_equal(result.camera.world_to_camera, found.cameras[0].world_to_camera)
    assert result.report["camera"]["accepted"] and result.report["camera"]["moved"] == pytest.approx(found.moved[0])
    as_given, = refine_views(views, small.depths, names=names, device=device,
                             config=config.with_settings(effects__cameras="off"))
    assert as_given.camera is cameras[0]


@pytest.mark.filterwarnings("ignore:nothing was refined")
def test_a_view_without_a_surface_does_not_take_the_figures_of_another(small, small_off, device):
    """Of two views that are requested the first one is left out: the second one's `moved` was the first one's."""
    cameras, _ = small_off
    config = pagas_cl.preset("balanced").with_settings(pyramid__steps=(4,), agreement__steps=0.0)
    depths = [np.zeros_like(depth) if k == 3 else depth for k, depth in enumerate(small.depths)]
    result, = pagas_cl.refine_views(small.through(cameras), depths, config=config, device=device,
                                    names=[small.views[3].name, small.views[0].name])
    assert result.name == small.views[0].name and np.isfinite(result.report["camera"]["moved"])


def test_that_cameras_of_many_views_are_not_checked_is_logged(relief, caplog):
    with caplog.at_level("INFO", "pagas_cl"):
        views, config, found = resolve_cameras(43 * relief.views, 43 * relief.depths, pagas_cl.preset("balanced"))
    assert found is None and config.effects.cameras == "set" and views[0] is relief.views[0]
    assert "not checked (of more than 300 views" in caplog.text


def test_depth_maps_that_disagree_by_a_factor(relief, device):
    factors = np.array([1.02, 0.95, 1.12, 0.84, 1.05, 0.97, 1.0])
    depths = [depth * np.float32(factor) for depth, factor in zip(relief.depths, factors)]
    found = refine_cameras(relief.through(noisy(relief.cameras, 0.5, 0)), depths, unknowns=("pose", "depth_scale"),
                           device=device)
    scales = found.depth_scales * factors
    assert found.accepted and np.ptp(scales) < 0.005 and scales.mean() == pytest.approx(1, abs=0.05)
    assert (found.depth_shifts == 0).all() and relief.error(found.cameras) < 0.2
    with pytest.raises(InputError, match="a mesh was given"):
        refine_cameras(relief.views, (np.eye(3), np.arange(3)[None]), unknowns=("depth_scale",), device=device)


def test_depth_maps_of_another_scale_are_scaled(relief, off_by_one, device):
    """The cameras keep theirs, which show it to 0.2 % here; a scale that is nearly theirs is the surface's."""
    large = [depth * np.float32(1.04) for depth in relief.depths]
    found = refine_cameras(relief.through(off_by_one[0]), large, device=device)
    assert found.accepted and found.depth_scales == pytest.approx(np.full(7, 1 / 1.04), abs=8e-3)
    scaled = found.scaled(large)
    assert np.median(scaled[0] / relief.depths[0]) == pytest.approx(1, abs=8e-3) and "scaled by 0.96" in str(found)
    assert relief.error(found.cameras) < 0.1
    with pytest.raises(InputError, match="6 depth maps were given for 7 views, expected one each"):
        found.scaled(large[1:])
    kept = off_by_one[1].scaled(large)
    assert off_by_one[1].depth_scales is None and all(a is b for a, b in zip(kept, large))


def test_a_lens_of_its_own(relief, device):
    """Half of the views were taken with a longer lens than they say."""
    lenses = [0, 0, 0, 0, 1, 1, 1]
    cameras = [replace(c, fx=c.fx * (1 + 0.01 * lens), fy=c.fy * (1 + 0.01 * lens))
               for c, lens in zip(noisy(relief.cameras, 0.3, 0), lenses)]
    found = refine_cameras(relief.through(cameras), relief.depths, unknowns=("pose", "focal"), lenses=lenses,
                           device=device)
    ratio = found.cameras[5].fx / found.cameras[0].fx
    assert found.accepted and ratio == pytest.approx(1, abs=0.003) and found.cameras[4].fx == found.cameras[6].fx
    assert found.cameras[0].cx == cameras[0].cx


def test_a_mesh_stays_where_it_is(relief, off_by_one, device):
    pytest.importorskip("open3d")
    cameras, by_depth = off_by_one
    found = refine_cameras(relief.through(cameras), relief.scene.initial_mesh(), device=device)
    assert found.accepted and relief.error(found.cameras) < 0.1


def test_a_mesh_says_where_the_world_is(relief):
    """A similarity of cameras and depths, which no photo sees, is taken back; not where the cameras are sure."""
    turn, shift = exponential(np.array([2e-3, -1e-3, 1e-3, 0.4, -0.3, 1.5]))
    cameras = [placed(c, c.world_to_camera[:3, :3] @ turn.T, 1.003 * (turn @ c.center) + shift) for c in relief.cameras]
    depths = [1.003 * relief.scene.true_depth(camera) for camera in relief.cameras]
    drawn = [relief.scene.true_depth(camera) for camera in cameras]
    back = list(map(register_to_mesh(cameras, depths, drawn, 10.0), cameras))
    before, after = (rms_motion(relief.cameras, those, relief.depths) for those in (cameras, back))
    assert before > 0.3 and after < 0.15 * before
    sure = list(map(register_to_mesh(cameras, depths, drawn, 1e-3), cameras))
    assert rms_motion(cameras, sure, relief.depths) < 0.01
    thin = [np.where(np.indices(depth.shape).sum(axis=0) % 2, depth, 0) for depth in drawn]      # no normal is known
    one = list(map(register_to_mesh(cameras, depths, [thin[0], *drawn[1:]], 10.0), cameras))
    assert rms_motion(relief.cameras, one, relief.depths) < 0.15 * before
    assert register_to_mesh(cameras, depths, thin, 10.0)(cameras[0]) is cameras[0]


def test_a_colmap_model_keeps_all_but_poses(relief, off_by_one, tmp_path, capsys):
    """The command, on a model with points, from depth maps; and a scene that has no such model."""
    pycolmap = pytest.importorskip("pycolmap")
    from PIL import Image

    from pagas_cl.__main__ import run
    from pagas_cl.method.cameras.model import write_model
    from pagas_cl.scene.depthmap import save_depth

    cameras, found = off_by_one
    named = [replace(view, image=tmp_path / f"images/{view.name}.png", name=f"{view.name}.png")
             for view in relief.through(cameras)]
    (tmp_path / "images").mkdir()
    (tmp_path / "depth").mkdir()
    for view, made, depth in zip(named, relief.views, relief.depths):
        Image.fromarray(made.load_image()).save(view.image)
        save_depth(tmp_path / f"depth/{view.stem}.npz", depth)
    model = pycolmap.Reconstruction(str(write_model(tmp_path / "nothing", named, cameras, tmp_path)))
    model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track(), np.array([9, 8, 7], np.uint8))
    model.write_binary(str(tmp_path / "sparse/0"))
    rest = ["--output", str(tmp_path / "out"), "--quiet"]
    assert run(["cameras", str(tmp_path), "--depth-dir", str(tmp_path / "depth"), *rest]) == 0
    assert "moved" in capsys.readouterr().out and (tmp_path / "out/cameras_report.json").is_file()
    after = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    assert after.num_points3D() == 1 and {i: im.name for i, im in after.images.items()} == {
        i: im.name for i, im in model.images.items()}
    by_name = {image.name: image for image in after.images.values()}
    read = [pagas_cl.Camera.from_colmap(after.cameras[by_name[v.name].camera_id], by_name[v.name]) for v in named]
    true = [relief.cameras[[v.name for v in relief.views].index(view.stem)] for view in named]
    assert rms_motion(true, after_similarity(read, true), relief.depths) < 0.06


def test_a_rig_is_written_as_single_cameras(relief, tmp_path, caplog):
    """Photos of a rig's frame have one pose in common in COLMAP's files; each refined pose is of one photo."""
    pycolmap = pytest.importorskip("pycolmap")
    from pagas_cl.method.cameras.model import write_model

    left, right = relief.cameras[:2]
    poses = [pycolmap.Rigid3d(camera.world_to_camera[:3]) for camera in (left, right)]
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2)]
    given, rig, frame = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], poses[1] * poses[0].inverse())
    for number, sensor in enumerate(sensors, 1):
        given.add_camera(pycolmap.Camera(camera_id=number, model="PINHOLE", width=left.width, height=left.height,
                                         params=[left.fx, left.fy, left.cx, left.cy]))
        frame.add_data_id(pycolmap.data_t(sensor, number))
    frame.rig_from_world = poses[0]
    given.add_rig(rig)
    given.add_frame(frame)
    for number in (1, 2):
        given.add_image(pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number, frame_id=1,
                                       points2D=[pycolmap.Point2D(np.full(2, 9.0 * number))] * 2))
    given.register_frame(1)
    track = pycolmap.Track()
    for number in (1, 2):
        track.add_element(number, 1)
    point = given.add_point3D(np.ones(3), track, np.zeros(3, np.uint8))
    (tmp_path / "sparse/0").mkdir(parents=True)
    given.write_binary(str(tmp_path / "sparse/0"))
    views = [replace(relief.views[k], name=f"{k + 1}.png") for k in range(2)]
    moved = relief.cameras[2:4]
    after = pycolmap.Reconstruction(str(write_model(tmp_path, views, moved, tmp_path / "out")))
    assert "the rigs in" in caplog.text and "are written as single cameras" in caplog.text
    for number, camera in enumerate(moved, 1):
        image = after.images[number]
        assert np.abs(image.cam_from_world().matrix() - camera.world_to_camera[:3]).max() < 1e-9
        assert image.camera_id == number and image.points2D[1].point3D_id == point
    assert after.points3D[point].track.length() == 2


@pytest.mark.parametrize("model, share", [("PINHOLE", 1), ("SIMPLE_PINHOLE", 1), ("PINHOLE", 0.5)])
def test_a_colmap_model_gets_refined_lenses(relief, tmp_path, model, share):
    """At its own size, whatever that of the photos is (--photos)."""
    pycolmap = pytest.importorskip("pycolmap")
    from pagas_cl.method.cameras.model import write_model

    place = write_model(tmp_path / "nothing", relief.views, relief.cameras, tmp_path)
    given = pycolmap.Reconstruction(str(place))
    for lens in given.cameras.values():
        lens.model = model
        lens.params = [lens.params[0], *lens.params[-2:]] if model == "SIMPLE_PINHOLE" else lens.params
    given.write_text(str(place))
    for file in place.glob("*.bin"):
        file.unlink()
    longer = [replace(camera, fx=1.02 * camera.fx, fy=1.02 * camera.fy, cx=camera.cx + 3) for camera in relief.cameras]
    found = [camera.scaled(share) for camera in longer]
    after = pycolmap.Reconstruction(str(write_model(tmp_path, relief.views, found, tmp_path / "out")))
    for image in after.images.values():
        camera = longer[[view.name for view in relief.views].index(image.name)]
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy][-len(after.cameras[image.camera_id].params):]
        assert after.cameras[image.camera_id].params == pytest.approx(numbers)


def test_refined_lenses_are_of_pinholes_in_a_scene_of_their_own(relief, tmp_path, capsys):
    pycolmap = pytest.importorskip("pycolmap")
    from PIL import Image

    from pagas_cl.__main__ import run
    from pagas_cl.app.commands.cameras import _closing
    from pagas_cl.method.cameras.model import write_model

    read = {"--mesh": Path("m.ply"), "--depth-dir": None, "--photos": None}
    said = _closing(SimpleNamespace(accepted=True), *map(Path, ("scene", "new", "new/sparse/0")), read)
    assert "refine new --mesh m.ply" in said and "poses alone" in said and "new/images" in said
    (tmp_path / "images").mkdir()
    for view in relief.views:
        Image.fromarray(view.load_image()).save(tmp_path / f"images/{view.name}.png")
    named = [replace(view, name=f"{view.name}.png") for view in relief.views]
    model = pycolmap.Reconstruction(str(write_model(tmp_path / "nothing", named, relief.cameras, tmp_path)))
    for lens in model.cameras.values():
        fx, _, cx, cy = lens.params
        lens.model = "SIMPLE_RADIAL"
        lens.params = [fx, cx, cy, 0.01]
    model.write_binary(str(tmp_path / "sparse/0"))
    (tmp_path / "m.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    line = ["cameras", str(tmp_path), "--mesh", str(tmp_path / "m.off"), "--output", str(tmp_path / "out")]
    assert run([*line, "--unknowns", "pose", "focal"]) == 2 and "is distorted" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_camera_that_was_not_tried_has_no_number():
    from pagas_cl.app.commands.cameras import table

    nothing = SimpleNamespace(accepted=False, left_out=(), pairs=(), moved=[np.nan, 0.25])
    assert [line.split() for line in table(nothing, ["a.png", "b.png"]).splitlines()[1:3]] == [
        ["a.png", "-"], ["b.png", "0.250"]]


def test_pairs_that_judge_take_no_part(relief):
    pairs = choose_pairs(relief.cameras, relief.depths, Context())
    assert len(pairs.held) == 3
    for one, two in pairs.held:
        assert two not in pairs.used[one] and one not in pairs.used[two]
    assert all(len(others) >= 2 for others in pairs.used)
    less = pairs.without({0})
    assert less.used[0] == () and all(0 not in others for others in less.used)
    assert all(0 not in pair for pair in less.held)


def test_wide_pairs_judge_too(relief, device):
    """Of views with few context views the farthest that see the same; a made scene gains there, a bent one does not."""
    from pagas_cl.method.cameras.accept import bent

    context = Context(number=3)
    pairs = choose_pairs(relief.cameras, relief.depths, context)
    assert pairs.wide and pairs == choose_pairs(relief.cameras, relief.depths, context)
    for one, two in pairs.wide:
        assert two not in pairs.used[one] and one not in pairs.used[two] and (one, two) not in pairs.held
    assert all(0 not in pair for pair in pairs.without({0}).wide)
    config = pagas_cl.preset("balanced").with_settings(context__number=3)
    found = refine_cameras(relief.through(noisy(relief.cameras, 1.0, 0)), relief.depths, config=config, device=device)
    assert found.accepted and len(found.report["wide_pairs"]) >= 3
    assert all(pair["after"] < pair["before"] for pair in found.report["wide_pairs"])
    assert bent(np.zeros((0, 2)), 0, 0) == "" == bent(np.array([[0.2, 0.1], [0.1, 0.09]]), 100, 90)
    assert "1 of 2 wide pairs better" in bent(np.array([[0.1, 0.09], [0.1, 0.15]]), 100, 100)
    assert "bends" in bent(np.array([[0.2, 0.1]]), 100, 50)


def test_the_pose_of_a_photo_that_judges_is_fitted(relief, device):
    """To the surface that it judges, also where coarse photos are too small to show anything of it."""
    from pagas_cl.method.cameras.judge import fitted_pose

    target, truth = relief.views[0], [relief.scene.true_depth(camera) for camera in relief.cameras]
    for k, pixels in ((1, 0.0), (2, 0.5), (5, 2.0)):
        off = noisy(relief.cameras, pixels, 4)[k]
        judge = fitted_pose(replace(relief.views[k], camera=off), target, truth[0], truth[k], device)
        left = rms_motion([relief.cameras[k]], [judge.camera], [truth[k]])
        assert left < 0.05, (k, pixels, left)
    blank = replace(target, image=np.full((145, 194, 3), 128, np.uint8))      # shows no pose
    stays = fitted_pose(replace(relief.views[5], camera=off), blank, truth[0], None, device)
    assert rms_motion([off], [stays.camera], [truth[5]]) < 0.1


def test_twists_come_back(relief):
    rng = np.random.default_rng(3)
    for size in (1e-9, 1e-3, 0.5, 3.0):
        w, v = rng.normal(size=3), rng.normal(size=3)
        twist = np.concatenate([size * w / np.linalg.norm(w), v])
        camera = moved(relief.cameras[0], twist, 650.0)
        assert twist_between(relief.cameras[0], camera, 650.0) == pytest.approx(twist, abs=1e-9)
    assert np.isnan(pixel_motion(camera, camera, np.zeros((0, 3))))
