"""Camera: identities of projection, and every constructor's convention."""

import numpy as np
import pytest
from conftest import look_at
from hypothesis import given, settings
from hypothesis import strategies as st

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, inverse_pose

FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture
def camera():
    return look_at((3, -1, -4), (0.2, 0.1, 0), name="a.png")


def test_rays_project_back_to_pixel_centres(camera):
    world = (camera.rays() * 2.5) @ camera.world_to_camera[:3, :3] + camera.center
    uv, z = camera.project(world)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    assert np.abs(uv - np.stack([columns, rows], -1)).max() < 1e-9
    assert np.abs(z - 2.5).max() < 1e-12


def test_look_at_looks_at_it(camera):
    uv, z = camera.project([0.2, 0.1, 0.0])
    assert np.allclose(uv, (camera.cx, camera.cy)) and z > 0


@pytest.mark.parametrize("build, pose", [
    (Camera.from_opencv_w2c, lambda p: p),
    (Camera.from_c2w, lambda p: np.linalg.inv(p)),
    (Camera.from_opengl_c2w, lambda p: np.linalg.inv(p) @ FLIP),
])
@pytest.mark.parametrize("centre", [0.5, 0.0])
def test_constructors_agree(camera, build, pose, centre):
    K = camera.K
    K[:2, 2] -= 0.5 - centre
    made = build(K, pose(camera.world_to_camera), camera.width, camera.height, pixel_center=centre)
    assert np.abs(made.K - camera.K).max() < 1e-12
    assert np.abs(made.world_to_camera - camera.world_to_camera).max() < 1e-12


def test_from_open3d_counts_from_whole_numbers(camera):
    o3d = pytest.importorskip("open3d")
    parameters = o3d.camera.PinholeCameraParameters()
    parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
    parameters.extrinsic = camera.world_to_camera
    made = Camera.from_open3d(parameters)
    assert np.abs(made.K - camera.K).max() < 1e-12
    assert np.abs(made.world_to_camera - camera.world_to_camera).max() < 1e-12


def test_from_colmap_refuses_distortion():
    pycolmap = pytest.importorskip("pycolmap")
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=48, params=[50, 32, 24, 0.1])
    with pytest.raises(InputError, match=r"SIMPLE_RADIAL.*read_scene\(folder\) undistorts"):
        Camera.from_colmap(lens, pycolmap.Image(name="a.png", camera_id=1))


def test_resized_keeps_the_image_corners(camera):
    half = camera.resized(40, 60)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    assert np.allclose(half.project(points)[0], camera.project(points)[0] * (40 / 160, 60 / 120))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.floats(0, 1e7))
def test_relative_pose_keeps_its_digits_far_from_the_origin(numbers, offset):
    place = np.array([offset, -offset, offset / 3])
    a = look_at(place + (3, 0.1, -4), place + numbers[:3])
    b = look_at(place + (-2, 0.5, -4), place + numbers[3:])
    rotation, tau = b.relative_to(a)
    full = b.world_to_camera @ inverse_pose(a.world_to_camera)
    assert np.abs(rotation - full[:3, :3]).max() < 1e-12
    centre = b.world_to_camera[:3, :3] @ (a.center - b.center)
    assert np.abs(tau - centre).max() <= 1e-12 * max(1, offset)


@pytest.mark.parametrize("change, message", [
    ({"width": 0}, "width is 0"), ({"height": 2.5}, "height is 2.5"), ({"fx": -1}, "fx is -1.0"),
    ({"cy": np.nan}, "cy is nan"), ({"world_to_camera": np.eye(4) * 2}, "no rotation|last row"),
    ({"world_to_camera": np.diag([1, 1, -1, 1.0])}, "no rotation"),
    ({"world_to_camera": np.full((4, 4), np.nan)}, "not finite"),
    ({"world_to_camera": np.eye(3)}, r"shape \(3, 3\)"),
    ({"width": None}, "width is None"), ({"height": np.inf}, "height is inf"), ({"fx": "f"}, "fx is 'f'"),
    ({"world_to_camera": "pose"}, r"pose is a str, .*\(4, 4\) or \(3, 4\)"),
])
def test_bad_cameras_are_refused_by_name(change, message):
    good = {"width": 8, "height": 6, "fx": 5, "fy": 5, "cx": 4, "cy": 3, "world_to_camera": np.eye(4), "name": "c7"}
    with pytest.raises(InputError, match=message) as error:
        Camera(**{**good, **change})
    assert "c7" in str(error.value)


K = np.array([[5, 0, 4], [0, 5, 3], [0, 0, 1.0]])


@pytest.mark.parametrize("given, message", [
    (K.T, r"K is \[\[5.0, 0.0, 0.0\].*expected \[\[fx, 0, cx\].*transpose"),
    (2 * K, "divide it by its last number"), ("K", "K is a str"), ([[5], [5, 3]], "K is no array"),
])
def test_a_K_that_is_none_is_refused_by_name(given, message):
    for make in (Camera.from_opencv_w2c, Camera.from_c2w, Camera.from_opengl_c2w):
        with pytest.raises(InputError, match=message) as error:
            make(given, np.eye(4), 8, 6, name="c7")
        assert "c7" in str(error.value)


@pytest.mark.parametrize("make, expected", [
    (lambda: Camera.from_opencv_w2c(K, np.eye(4), 8, 6, pixel_center="middle"), "pixel_center is 'middle', .*0.5 or 0"),
    (lambda: Camera.from_open3d(K), "array of float64, expected Open3D's PinholeCameraParameters"),
    (lambda: Camera.from_colmap("image", "camera"), "expected a pycolmap.Camera and its pycolmap.Image"),
])
def test_what_constructors_cannot_take_is_named(make, expected):
    with pytest.raises(InputError, match=expected):
        make()


def test_transposed_pose_is_recognised():
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    with pytest.raises(InputError, match="transposed"):
        Camera(8, 6, 5, 5, 4, 3, pose.T)
