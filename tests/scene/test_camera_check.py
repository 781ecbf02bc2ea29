"""The camera check names what is wrong with cameras, on a synthetic scene and on real photos."""

from dataclasses import replace

import numpy as np
import pytest
from support.camera_noise import noisy
from support.scenes import relief_scene
from support.synthetic.photo import photograph

from pagas_cl.app.commands.check import table
from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.check.cameras import check_cameras

pytestmark = pytest.mark.slow

FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="module")
def scene():
    made = relief_scene(160, 120, contexts=3, held_out=0)
    return made.initial_mesh(), [v.camera for v in made.views], [v.image for v in made.views]


def posed(cameras, change):
    return [replace(c, world_to_camera=change(c.world_to_camera)) for c in cameras]


def test_right_cameras(scene):
    mesh, cameras, images = scene
    report = check_cameras(mesh, cameras, images)
    assert report.ok and report.best == "as given"
    assert "4 of 4 cameras see the mesh" in report.sentence and "right as they are" in report.sentence
    assert report.readings[0].agreement > 0.9
    assert all(v.front == 1 and v.inside > 0.4 for v in report.views)
    assert "target" in table(report) and "inverted" in table(report)


def test_a_dome_around_the_scene_is_nearly_all_of_the_meshs_area(scene):
    """Compared over the area alone, photos agree with the mesh 0.0254 times as large: the dome is where it was then."""
    (vertices, faces), cameras, images = scene
    corners = 20_000 * np.concatenate([np.eye(3), -np.eye(3)])
    dome = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    mesh = np.concatenate([vertices, corners]), np.concatenate([faces, np.array(dome, np.int32) + len(vertices)])
    report = check_cameras(mesh, cameras, images)
    assert report.ok and "4 of 4 cameras see the mesh" in report.sentence and report.readings[0].agreement > 0.9


@pytest.mark.parametrize("with_photos", [True, False])
@pytest.mark.parametrize("name, change, mend", [
    ("inverted", inverse_pose, "Camera.from_c2w"),
    ("y and z flipped", lambda m: FLIP @ m, "Camera.from_opengl_c2w"),
    ("inverted, y and z flipped", lambda m: inverse_pose(FLIP @ m), "Camera.from_opengl_c2w"),
])
def test_wrong_poses_are_named(scene, name, change, mend, with_photos):
    mesh, cameras, images = scene
    report = check_cameras(mesh, posed(cameras, change), images if with_photos else None)
    assert not report.ok and report.best == name
    assert mend in report.sentence and "0 of 4" in report.sentence and "4 of 4" in report.sentence


@pytest.mark.parametrize("quarters, becomes", [(1, "z, -y"), (-1, "-z, y")])
def test_a_mesh_that_another_program_has_turned(scene, quarters, becomes):
    """Blender's exporters turn a mesh about x, of which cameras know nothing."""
    (vertices, faces), cameras, images = scene
    x, y, z = np.asarray(vertices).T
    report = check_cameras((np.column_stack([x, -quarters * z, quarters * y]), faces), cameras, images)
    assert not report.ok and report.best == f"for a mesh turned by {-90 * quarters} degrees about x"
    assert f"use the mesh so turned: put y, z of each of its points to {becomes}" in report.sentence
    assert f"another program has turned the mesh, which took y for up, or z: put y, z of each of its points to " \
           f"{becomes}" in report.at_command_line[1]


def test_the_constructor_named_mends_it(scene):
    mesh, cameras, images = scene
    opengl = [inverse_pose(c.world_to_camera) @ FLIP for c in cameras]
    wrong = [Camera.from_opencv_w2c(c.K, m, c.width, c.height) for c, m in zip(cameras, opengl)]
    assert "from_opengl_c2w(K, matrix" in check_cameras(mesh, wrong, images).sentence
    mended = [Camera.from_opengl_c2w(c.K, m, c.width, c.height) for c, m in zip(cameras, opengl)]
    assert check_cameras(mesh, mended, images).ok


def test_principal_point_from_the_bottom(scene):
    mesh, cameras, images = scene
    low = [replace(c, cy=c.cy + 9) for c in cameras]  # off centre, so that the two readings differ
    cropped = [np.roll(image, 9, axis=0) for image in images]
    assert check_cameras(mesh, low, cropped).ok
    report = check_cameras(mesh, [replace(c, cy=c.height - c.cy) for c in low], cropped)
    assert report.best == "principal point from the bottom" and "cy = height - cy" in report.sentence


def test_half_a_pixel_shows_where_cameras_are_rolled(scene):
    mesh, cameras, _ = scene
    made = relief_scene(160, 120, contexts=3, held_out=0)
    rolled = []
    for quarter, camera in zip((0, 1, 2, 3), cameras):
        turn = np.eye(4)
        c, s = np.round([np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)])
        turn[:2, :2] = [[c, -s], [s, c]]
        rolled.append(replace(camera, world_to_camera=turn @ camera.world_to_camera))
    images = [photograph(made.true_solid, made.skin, camera) for camera in rolled]
    assert "do not show a shift" in check_cameras(mesh, rolled, images).half_pixel
    off = [replace(c, cx=c.cx - 0.5, cy=c.cy - 0.5) for c in rolled]
    report = check_cameras(mesh, off, images)
    assert "prefer half a pixel more" in report.half_pixel and "pixel_center=0 " in report.half_pixel


@pytest.mark.parametrize("seed", [3, 13])
def test_poses_that_are_off_are_not_taken_for_pixel_centres_or_for_right(scene, seed):
    mesh, cameras, images = scene
    report = check_cameras(mesh, noisy(cameras, 1.5, seed), images)
    assert "do not show a shift" in report.half_pixel and not any(reading.better for reading in report.readings)
    assert "right" not in report.sentence.replace("rightly", "") and "'pagas-cl cameras' measures it" in report.sentence


def test_other_frame(scene):
    (vertices, faces), cameras, images = scene
    report = check_cameras((vertices + [5e5, 4e6, 0], faces), cameras, images)
    assert not report.ok and "different coordinate frames" in report.sentence
    assert report.sentence not in table(report), "the command's error says it, once"


def test_bad_input(scene):
    mesh, cameras, images = scene
    with pytest.raises(InputError, match="1 images were given for 4 cameras"):
        check_cameras(mesh, cameras, images[:1])
    with pytest.raises(InputError, match="no cameras were given"):
        check_cameras(mesh, [], [])
    with pytest.raises(InputError, match="has an area"):
        check_cameras((np.zeros((3, 3)), np.array([[0, 1, 2]])), cameras, images)


def test_real_photos_and_command(data_dir, capsys):
    pytest.importorskip("open3d")
    from pagas_cl.__main__ import run

    scene = data_dir / "dtu_scan24"
    mesh = scene / "derived" / "mesh_coarse.ply"
    assert run(["check", str(scene), "--mesh", str(mesh), "--format", "neus"]) == 0
    out = capsys.readouterr().out
    assert "16 of 16 cameras see the mesh" in out and "right as they are" in out
    # millimetres against NeuS's unit sphere
    from pagas_cl.scene.readers import read_scene

    sphere = read_scene(scene, "neus", frame="sphere")
    report = check_cameras(mesh, sphere.cameras[:4], [v.image for v in sphere.views[:4]])
    assert "different coordinate frames" in report.sentence
