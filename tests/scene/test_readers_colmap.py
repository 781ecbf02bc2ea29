"""Readers of COLMAP models and cameras.json: real models, models that pycolmap writes, and everything missing."""

import logging
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pagas_cl.app.commands._given import look
from pagas_cl.errors import InputError
from pagas_cl.scene.depthmap import save_depth
from pagas_cl.scene.lens import Lens
from pagas_cl.scene.readers import FORMATS, camera_file, colmap, read_scene
from pagas_cl.scene.view import View

pycolmap = pytest.importorskip("pycolmap")


def write_model(folder, cameras, *, model="PINHOLE", extra=(), binary=True, place="sparse/0", photos=True):
    """A scene folder with one COLMAP camera and the poses of `cameras`."""
    first = cameras[0]
    params = {"PINHOLE": [first.fx, first.fy, first.cx, first.cy], "SIMPLE_PINHOLE": [first.fx, first.cx, first.cy],
              "SIMPLE_RADIAL": [first.fx, first.cx, first.cy, *extra],
              "OPENCV": [first.fx, first.fy, first.cx, first.cy, *extra],
              "OPENCV_FISHEYE": [first.fx, first.fy, first.cx, first.cy, *extra]}[model]
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(model=model, width=first.width, height=first.height,
                                                     params=params, camera_id=1))
    for number, camera in enumerate(cameras, 1):
        image = pycolmap.Image(name=camera.name, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.world_to_camera[:3]))
    target = folder / place
    target.mkdir(parents=True, exist_ok=True)
    (made.write_binary if binary else made.write_text)(str(target))
    if photos:
        rng = np.random.default_rng(0)
        for camera in cameras:
            path = folder / "images" / camera.name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(rng.integers(0, 256, (first.height, first.width, 3), dtype=np.uint8)).save(path)
    return folder


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_pinhole_models_come_back_exactly(tmp_path, ring, binary, place):
    scene = read_scene(write_model(tmp_path, ring, binary=binary, place=place))
    assert [view.name for view in scene.views] == [camera.name for camera in ring]
    for view, camera in zip(scene.views, ring):
        assert np.abs(view.camera.world_to_camera - camera.world_to_camera).max() < 1e-9
        assert np.abs(view.camera.K - camera.K).max() < 1e-9
        assert view.load_image().shape == (120, 160, 3) and view.load_mask() is None


def test_a_text_model_that_windows_has_saved(tmp_path, ring):
    folder = write_model(tmp_path, ring, binary=False)
    for part in ("cameras", "images"):
        path = folder / "sparse/0" / f"{part}.txt"
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert [view.name for view in read_scene(folder).views] == [camera.name for camera in ring]


def test_simple_pinhole_and_sub_folders(tmp_path, ring):
    named = [replace(camera, name=f"cam{i}/a.png") for i, camera in enumerate(ring[:2])]
    (tmp_path / "masks" / "cam0").mkdir(parents=True)
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(tmp_path / "masks" / "cam0" / "a.png")
    Image.fromarray(np.zeros((120, 160), np.uint8)).save(tmp_path / "masks" / "a.png")
    scene = read_scene(write_model(tmp_path, named, model="SIMPLE_PINHOLE"))
    assert scene.views[0].camera.fx == scene.views[0].camera.fy == ring[0].fx
    assert scene.views[0].load_mask().all() and not scene.views[1].load_mask().any()


@pytest.mark.parametrize("model, extra", [("SIMPLE_RADIAL", [-0.1]), ("OPENCV", [0.1, -0.05, 0.002, -0.001]),
                                          ("OPENCV_FISHEYE", [0.02, 0.001, 0, 0])])
def test_distorted_photos_are_undistorted(tmp_path, ring, model, extra, caplog):
    """A picture of what the pixel's ray is, so that any slip of the resampling shows as an error in pixels."""
    folder = write_model(tmp_path, ring[:2], model=model, extra=extra)
    lens = pycolmap.Reconstruction(str(folder / "sparse/0")).cameras[1]
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = lens.cam_from_img(np.stack([columns, rows], -1).reshape(-1, 2)).reshape(120, 160, 2)
    Image.fromarray(np.dstack([np.rint(np.clip(128 + 150 * rays, 0, 255)), np.zeros((120, 160))]).astype(np.uint8)
                    ).save(folder / "images" / ring[0].name)
    (folder / "masks").mkdir()
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(folder / "masks" / ring[0].name)
    with caplog.at_level(logging.INFO, "pagas_cl"):
        view = read_scene(folder).views[0]
    assert f"camera 1 is {model}: its photos are undistorted" in caplog.text
    assert "1 of 2 views have no mask" in caplog.text
    photo, camera = view.load_image(), view.camera
    want = 128 + 150 * camera.rays()[..., :2]
    inside = ((want > 1) & (want < 254)).all(-1)
    inside[:2] = inside[-2:] = inside[:, :2] = inside[:, -2:] = False
    assert inside.mean() > 0.5
    assert np.abs(photo[..., :2] - want)[inside].max() < 1.6  # 8-bit steps, of about a pixel each
    assert abs((photo[..., :2] - want)[inside].mean()) < 0.1  # half a pixel would be 0.5
    assert view.load_mask().shape == photo.shape[:2] and view.load_mask().all()


def test_depth_maps_of_distorted_photos_are_undistorted(tmp_path, ring):
    """A depth that tells its pixel's ray; a map of the undistorted photo's size stays as it is."""
    folder = write_model(tmp_path, ring[:2], model="SIMPLE_RADIAL", extra=[-0.1])
    lens = pycolmap.Reconstruction(str(folder / "sparse/0")).cameras[1]
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = lens.cam_from_img(np.stack([columns, rows], -1).reshape(-1, 2)).reshape(120, 160, 2)
    (folder / "depth").mkdir()
    save_depth(folder / "depth" / f"{Path(ring[0].name).stem}.npz", 5 + rays[..., 0])
    view = read_scene(folder).views[0]
    width, height = view.camera.width, view.camera.height
    assert (width, height) != (160, 120)
    save_depth(folder / "depth" / f"{Path(ring[1].name).stem}.npz", np.full((height, width), 2.0))
    taken, undistorted = look(folder, depth_dir=folder / "depth").depths
    depth = taken.load()
    assert depth.shape == (height, width) and (depth > 0).mean() > 0.5
    assert np.abs(depth - 5 - view.camera.rays()[..., 0])[depth > 0].max() < 1 / view.camera.fx
    assert (undistorted.load() == 2).all()


def test_lens_without_a_pinhole_is_refused():
    if "EQUIRECTANGULAR" not in pycolmap.CameraModelId.__members__:
        pytest.skip("this pycolmap knows no panoramas")
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=64, height=32, params=[])
    with pytest.raises(InputError, match="EQUIRECTANGULAR.*cannot be undistorted.*image_undistorter .a panorama"):
        Lens.from_colmap(camera, "a.png")


def test_missing_photos_are_counted_and_named(tmp_path, ring):
    folder = write_model(tmp_path, ring)
    for i in (1, 3, 4, 5):
        (folder / "images" / f"view{i}.png").unlink()
    with pytest.raises(InputError, match="4 of 7 photos .* missing in .*: 'view1.png', 'view3.png', 'view4.png' and 1"):
        read_scene(folder)
    (folder / "images" / "view0.png").rename(folder / "images" / "view0.jpg")
    with pytest.raises(InputError, match="5 of 7 .* 'view3.png' and 2 more .there is 'view0.jpg', which needs the"):
        read_scene(folder)
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="images' does not exist"):
        read_scene(folder)


@pytest.mark.parametrize("there, hint", [
    ("cam e\u0301/a.png", "'cam e\u0301/a.png', which needs the model's name: its accents are encoded otherwise)"),
    ("Cam \u00e9/a.JPG", "(there is 'Cam \u00e9/a.JPG', which needs the model's name)"), ("other/a.png", "'; copy"),
    ("cam \u00e9/a.json", "'; copy")])
def test_a_missing_photo_is_there_under_a_name_that_looks_the_same(tmp_path, ring, there, hint):
    """Archives of macOS have accents as characters of their own; a name of another folder is another photo's."""
    named = [replace(camera, name=f"cam \u00e9/{'ab'[i]}.png") for i, camera in enumerate(ring[:2])]
    folder = write_model(tmp_path, named)
    (folder / "images" / there).parent.mkdir(exist_ok=True)
    (folder / "images" / named[0].name).rename(folder / "images" / there)
    with pytest.raises(InputError, match=re.escape(hint)):
        read_scene(folder)


def test_photos_of_a_model_are_where_the_caller_says(tmp_path, ring, caplog):
    """COLMAP's image path may be any folder; of 3DGS's data sets often images_2, images_4 alone are there."""
    folder = write_model(tmp_path / "scene", ring)
    full = read_scene(folder)
    (folder / "images").rename(tmp_path / "photos")
    with pytest.raises(InputError, match="images' does not exist; .* or in the folder of --photos"):
        read_scene(folder)
    for place in (folder, folder / "sparse/0"):
        for given, view in zip(full.views, read_scene(place, photos=tmp_path / "photos").views):
            assert view.camera.K.tolist() == given.camera.K.tolist() and view.image.parent == tmp_path / "photos"
    for path in (tmp_path / "photos").iterdir():
        Image.open(path).resize((53, 40)).save(path)      # 160 x 120, divided by 3, to whole pixels
    with caplog.at_level(logging.INFO, "pagas_cl"):
        views = read_scene(folder, photos=tmp_path / "photos").views
    assert "cameras belong to photos of 160 x 120; they are scaled to those in" in caplog.text
    for given, view in zip(full.views, views):
        assert np.array_equal(view.camera.K, given.camera.resized(53, 40).K)
    (tmp_path / "photos").rename(folder / "images")
    with pytest.raises(InputError, match="is 53 x 40, its camera says 160 x 120: .*of a COLMAP model: --photos"):
        read_scene(folder)
    assert read_scene(folder, photos=folder / "images").views[0].camera.width == 53
    (folder / "images").rename(tmp_path / "photos")
    Image.new("RGB", (40, 40)).save(tmp_path / "photos" / "view2.png")
    with pytest.raises(InputError, match="image 'view2.png' is 40 x 40, its camera says 160 x 120: the shapes differ"):
        read_scene(folder, photos=tmp_path / "photos")


@pytest.mark.parametrize("with_images", [True, False])
def test_distorted_photos_at_another_size_are_undistorted(tmp_path, ring, with_images):
    """As the photos of images_2 next to images/, of which alone the model speaks, were taken: through the lens."""
    folder = write_model(tmp_path, ring[:2], model="OPENCV", extra=[-0.2, 0.05, 0, 0])
    ramp = np.arange(160) + 0 * np.arange(120)[:, None]
    for view in ring[:2]:
        Image.fromarray(np.dstack([ramp] * 3).astype(np.uint8)).save(folder / "images" / view.name)
    full = read_scene(folder).views[0]
    row = full.load_image()[full.camera.height // 2, :, 0]
    shutil.copytree(folder / "images", folder / "images_2")
    for path in (folder / "images_2").iterdir():
        Image.open(path).resize((80, 60), Image.Resampling.BOX).save(path)
    if not with_images:
        shutil.rmtree(folder / "images")
    half = read_scene(folder, photos=folder / "images_2").views[0]
    assert np.abs(half.camera.K - full.camera.resized(full.camera.width // 2, full.camera.height // 2).K).max() < 1
    photo, camera = half.load_image(), half.camera
    columns = np.arange(camera.width) + 0.5
    at = (columns - camera.cx) / camera.fx * full.camera.fx + full.camera.cx - 0.5
    want = np.interp(at, np.arange(len(row)), row)[4:-4]
    assert np.abs(photo[camera.height // 2, 4:-4, 0] - want).max() < 1.5


def test_other_models_next_to_the_one_that_is_read(tmp_path, ring, caplog):
    write_model(tmp_path, ring[:3])
    write_model(tmp_path, ring, place="sparse/1")
    read_scene(tmp_path)
    assert "sparse/0 is read; sparse/1 next to it are other models, of photos" in caplog.text
    assert f"give {tmp_path / 'sparse/1'}, say, as SCENE" in caplog.text
    assert len(read_scene(tmp_path / "sparse/1", photos=tmp_path / "images").views) == len(ring)
    shutil.rmtree(tmp_path / "sparse/0")
    with pytest.raises(InputError, match="no cameras in a supported format.*sparse/1' has one: give that folder"):
        read_scene(tmp_path)
    (tmp_path / "ws").mkdir()
    write_model(tmp_path / "ws/dense", ring, place="sparse")
    with pytest.raises(InputError, match="ws/dense' has one: give that folder"):
        read_scene(tmp_path / "ws")


def test_a_folder_that_may_not_be_entered_holds_no_model(tmp_path, monkeypatch):
    def stat(path, **more):
        if isinstance(path, (str, Path)) and "locked" in Path(path).parent.parts:
            raise PermissionError(13, "Permission denied", str(path))
        return whole(path, **more)

    whole = os.stat
    (tmp_path / "locked").mkdir()
    monkeypatch.setattr(os, "stat", stat)
    with pytest.raises(InputError, match="no cameras in a supported format"):
        read_scene(tmp_path)


def test_size_mismatch_is_reported_before_any_work(tmp_path, ring):
    folder = write_model(tmp_path, ring)
    Image.fromarray(np.zeros((60, 80, 3), np.uint8)).save(folder / "images" / "view2.png")
    with pytest.raises(InputError, match=r"image 'view2.png' is 80 x 60, its camera says 160 x 120"):
        read_scene(folder)
    (folder / "images" / "view2.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="view2.png' cannot be read .*of 8 or 16 bits"):
        read_scene(folder)


def test_masks_of_nothing_or_of_another_size(tmp_path, ring):
    folder = write_model(tmp_path, ring)
    (folder / "masks").mkdir()
    with pytest.raises(InputError, match="no mask in .* belongs to any photo; expected names like view0.png"):
        read_scene(folder)
    Image.fromarray(np.zeros((10, 10), np.uint8)).save(folder / "masks" / "view0.png.png")
    with pytest.raises(InputError, match="view0.png.png' of view 'view0.png' is 10 x 10, its camera says 160 x 120"):
        read_scene(folder)


def test_names_that_lead_out_of_the_scene(tmp_path, ring):
    from dataclasses import replace

    folder = write_model(tmp_path, [replace(ring[0], name="../../etc/passwd")], photos=False)
    with pytest.raises(InputError, match="leads out"):
        read_scene(folder)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_cut_off_models(tmp_path, ring, name):
    folder = write_model(tmp_path, ring)
    path = folder / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError):
        read_scene(folder)


def test_no_scene_and_unknown_format(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_scene(tmp_path / "no")
    with pytest.raises(InputError, match="no cameras in a supported format"):
        read_scene(tmp_path)
    with pytest.raises(InputError, match="unknown format 'x', expected one of cameras, colmap"):
        read_scene(tmp_path, "x")
    with pytest.raises(InputError, match="no COLMAP model: looked for"):
        read_scene(tmp_path, "colmap")
    assert not colmap.detect(tmp_path) and {"cameras", "colmap"} <= set(FORMATS)


def test_camera_file_round_trip(tmp_path, ring):
    folder = write_model(tmp_path, ring)
    views = read_scene(folder).views
    (folder / "masks").mkdir()
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(folder / "masks" / "m.png")
    views[0] = View(views[0].camera, views[0].image, folder / "masks" / "m.png", views[0].name)
    camera_file.write(folder, views)
    back = read_scene(folder)
    assert back.source.endswith("cameras.json")
    for a, b in zip(views, back.views):
        assert np.array_equal(a.camera.world_to_camera, b.camera.world_to_camera)
        assert np.array_equal(a.camera.K, b.camera.K)
        assert a.name == b.name and a.image == b.image
    assert back.views[0].load_mask().all() and back.views[1].mask is None


@pytest.mark.parametrize("change, message", [
    (lambda d: d.update(convention="opengl"), "convention is 'opengl', expected"),
    (lambda d: d.update(views=[]), "'views'"), (lambda d: d["views"][1].pop("fx"), "view 1: 'fx' is missing"),
    (lambda d: d["views"][0].update(width="9"), "'9', expected a number"),
    (lambda d: d["views"][0].update(image="no.png"), "no.png"),
    (lambda d: d["views"][0].update(image="../cameras.json"), "leads out"),
    (lambda d: d["views"][0].update(mask="no.png"), "no.png"),
    (lambda d: d["views"][0].update(width=80), "160 x 120, its camera says 80 x 120"),
])
def test_camera_file_errors(tmp_path, ring, change, message):
    import json

    folder = write_model(tmp_path, ring[:2])
    path = camera_file.write(folder, read_scene(folder).views)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        read_scene(folder, "cameras")


@pytest.mark.parametrize("name, count, size", [("dtu_scan24", 16, (1600, 1200)), ("sceaux_castle", 10, (2832, 2128))])
def test_real_models(data_dir, name, count, size):
    scene = read_scene(data_dir / name)
    assert len(scene.views) == count and scene.source.startswith("COLMAP")
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == size
    assert scene.views[-1].load_image().shape == (size[1], size[0], 3)
