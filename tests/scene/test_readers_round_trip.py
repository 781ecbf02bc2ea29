"""camera -> each format -> camera: to 1e-9 where the format allows, the loss named where it does not."""

import json

import numpy as np
import pytest
from PIL import Image
from support import rigs, scene_writers

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import meshlab, read_scene

OFFSETS = {"origin": (0, 0, 0), "utm": rigs.UTM}


def write_mvsnet(folder, views):
    scene_writers.mvsnet(folder, views, (0.5, 0.01))


def write_neus(folder, views):
    scene_writers.neus(folder, views, np.diag([3.0, 3, 3, 1]))


def write_open3d(folder, views):
    scene_writers.open3d_json(folder / "trajectory.json", [v.camera for v in views])


def write_log(folder, views):
    scene_writers.open3d_log(folder / "trajectory.log", [v.camera for v in views])


def write_meshlab(folder, views):
    meshlab.write_project(folder / "project.mlp", views)


KEEPS_ALL = {"nerfstudio": scene_writers.nerfstudio, "mvsnet": write_mvsnet, "neus": write_neus,
             "open3d": write_open3d, "meshlab": write_meshlab}


def assert_same(views, scene):
    assert [v.name for v in scene.views] == [v.name for v in views]
    for before, after in zip(views, scene.views):
        assert rigs.worst_difference(before.camera, after.camera) < 1e-9
        assert after.load_image().shape == (before.camera.height, before.camera.width, 3)


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("name", KEEPS_ALL)
def test_camera_survives(tmp_path, name, offset):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(offset=OFFSETS[offset]))
    KEEPS_ALL[name](tmp_path, views)
    options = {"flavour": "meshlab"} if name == "meshlab" else {}
    assert_same(views, read_scene(tmp_path, name, **options))


def test_format_is_found_by_looking(tmp_path):
    for name, write in {**KEEPS_ALL, "bundler": scene_writers.bundler}.items():
        (tmp_path / name).mkdir()
        views = rigs.with_photos(tmp_path / name, rigs.random_cameras(centred=True, square=True))
        write(tmp_path / name, views)
        assert_same(views, read_scene(tmp_path / name))


@pytest.mark.parametrize("offset", OFFSETS)
def test_log_keeps_poses_and_needs_one_set_of_intrinsics(tmp_path, offset):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(offset=OFFSETS[offset], same=True))
    write_log(tmp_path, views)
    assert_same(views, read_scene(tmp_path, "open3d"))
    (tmp_path / "camera_intrinsic.json").unlink()
    with pytest.raises(InputError, match="no intrinsics .*camera_intrinsic.json"):
        read_scene(tmp_path, "open3d")
    with pytest.raises(InputError, match="one set of intrinsics"):
        scene_writers.open3d_log(tmp_path / "t.log", rigs.random_cameras())


@pytest.mark.parametrize("offset", OFFSETS)
def test_bundler_keeps_centred_square_cameras_and_names_what_it_cannot_hold(tmp_path, offset):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(offset=OFFSETS[offset], centred=True, square=True))
    scene_writers.bundler(tmp_path, views)
    assert_same(views, read_scene(tmp_path, "bundler"))
    for keep, sentence in (({"square": True}, "principal point"), ({"centred": True}, "one focal length")):
        views = rigs.with_photos(tmp_path, rigs.random_cameras(**keep))
        with pytest.raises(InputError, match=sentence):
            scene_writers.bundler(tmp_path, views)


def test_bundlers_list_has_names_with_spaces_and_focal_lengths(tmp_path):
    cameras = rigs.random_cameras(centred=True, square=True)
    scene_writers.bundler(tmp_path, rigs.with_photos(tmp_path, cameras))
    plain = (tmp_path / "list.txt").read_text().split()
    for name in plain:
        (tmp_path / name).rename(tmp_path / name.replace("images/", "images/my 0 "))
    spaced = [name.replace("images/", "images/my 0 ") for name in plain]
    for end in ("", " 0 532.5"):
        (tmp_path / "list.txt").write_text("".join(f"{name}{end}\n" for name in spaced))
        views = read_scene(tmp_path, "bundler").views
        assert [f"images/{view.name}" for view in views] == spaced


@pytest.mark.parametrize("name", ["nerfstudio", "bundler"])
@pytest.mark.parametrize("places", [("images/left", "images/right"), ("left", "deep/right")])
def test_photos_of_two_cameras_may_share_their_names(tmp_path, name, places):
    """They were refused, since views were called by the files' names alone."""
    cameras = rigs.random_cameras(4, centred=True, square=True)
    views = [view for place, some in zip(places, (cameras[:2], cameras[2:]))
             for view in rigs.with_photos(tmp_path, some, place)]
    getattr(scene_writers, name)(tmp_path, views)
    (tmp_path / "masks" / places[1].removeprefix("images/")).mkdir(parents=True)
    mask = tmp_path / "masks" / places[1].removeprefix("images/") / "00000001.png"
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(mask)
    scene = read_scene(tmp_path, name)
    assert [view.name for view in scene.views] == [f"{place.removeprefix('images/')}/0000000{k}.png"
                                                   for place in places for k in range(2)]
    assert [view.mask for view in scene.views] == [None, None, None, mask]
    for before, after in zip(views, scene.views):
        assert before.image == after.image and rigs.worst_difference(before.camera, after.camera) < 1e-9


def test_neus_sphere_frame(tmp_path):
    views = rigs.with_photos(tmp_path, rigs.random_cameras())
    scale = np.diag([3.0, 3, 3, 1])
    scale[:3, 3] = (1, -2, 4)
    scene_writers.neus(tmp_path, views, scale)
    sphere = read_scene(tmp_path, "neus", frame="sphere")
    point = np.array([0.3, -0.2, 0.4])
    for world, inner in zip(views, sphere.views):
        uv, z = world.camera.project(scale[:3, :3] @ point + scale[:3, 3])
        uv2, z2 = inner.camera.project(point)
        assert np.abs(uv - uv2).max() < 1e-9 and abs(z - 3 * z2) < 1e-9


def test_nerf_synthetic_field_of_view_and_suffix(tmp_path):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(2, centred=True, square=True, same=True), "train")
    scene_writers.nerfstudio(tmp_path, views)
    data = json.loads((tmp_path / "transforms.json").read_text())
    camera = views[0].camera
    frames = [{"file_path": "./train/" + view.stem, "transform_matrix": frame["transform_matrix"]}
              for view, frame in zip(views, data["frames"])]
    (tmp_path / "transforms.json").unlink()
    angle = 2 * np.arctan(camera.width / 2 / camera.fx)
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    assert_same(views, read_scene(tmp_path))


@pytest.mark.parametrize("said, sentence", [
    ({"k2": 0.1}, "k2 is 0.1, expected 0"), ({"is_fisheye": True}, "is_fisheye is True, expected camera_model OPENCV"),
    ({"distortion_params": [0, 0, 0, 0, 0.01, 0]}, "distortion_params is .0, 0, 0, 0, 0.01, 0., expected 0"),
    ({"camera_model": "OPENCV_FISHEYE"}, "camera_model is 'OPENCV_FISHEYE', expected")])
@pytest.mark.parametrize("in_frame", [False, True])
def test_nerf_distortion_is_refused_however_it_is_said(tmp_path, said, sentence, in_frame):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(2))
    scene_writers.nerfstudio(tmp_path, views)
    path = tmp_path / "transforms.json"
    data = json.loads(path.read_text())
    none = {"k1": 0, "p2": 0.0, "is_fisheye": False, "distortion_params": [0.0] * 6}
    path.write_text(json.dumps({**data, **none}))
    assert_same(views, read_scene(tmp_path))
    (data["frames"][1] if in_frame else data).update(said)
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=f"frame {int(in_frame)}: {sentence}"):
        read_scene(tmp_path)


def test_mvsnet_intrinsics_of_another_size(tmp_path):
    views = rigs.with_photos(tmp_path, rigs.random_cameras(3))
    scene_writers.mvsnet(tmp_path, views)
    from dataclasses import replace

    small = [replace(v, camera=replace(v.camera, fx=v.camera.fx / 4, fy=v.camera.fy / 4, cx=v.camera.cx / 4,
                                       cy=v.camera.cy / 4)) for v in views]
    scene_writers.mvsnet(tmp_path, small)
    with pytest.raises(InputError, match="intrinsics_scale=4"):
        read_scene(tmp_path, "mvsnet")
    assert_same(views, read_scene(tmp_path, "mvsnet", intrinsics_scale=4.0))
