"""What networks, phones and RGB-D recordings leave: written, read back, the same cameras and depth; else refused."""

import json
import logging
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import exports, exports_depth, rigs
from support.example_scenes import METRES, as_network, frames_of, write_example
from support.exports_depth import EXPORTS, seen
from support.scenes import relief_scene

from pagas_cl.errors import InputError
from pagas_cl.scene.depth.placement import placements
from pagas_cl.scene.readers import FORMATS, read_scene

CENTRED = ("bundler", "vggt-colmap")      # hold no principal point
OPTIONS = {"meshlab": {"format": "meshlab", "flavour": "meshlab"}}


@pytest.fixture(scope="module")
def made():
    return relief_scene(168, 126, 2, held_out=0)


@pytest.fixture(scope="module")
def frames(made):
    return frames_of(made)


def read(folder, name):
    more = {"format": "colmap", "photos": folder / "photos"} if name == "mapanything-colmap" else OPTIONS.get(name, {})
    return read_scene(folder, **more)


@pytest.mark.parametrize("name", EXPORTS)
def test_round_trip(name, frames, tmp_path):
    EXPORTS[name](tmp_path, frames)
    scene = read(tmp_path, name)
    tolerance = 0.02 if name in CENTRED else 2e-7 if name in ("da3", "da3-npy", "vggt") else 1e-9
    assert len(scene.views) == len(frames)
    for view, frame in zip(scene.views, frames):
        assert rigs.worst_difference(view.camera, frame.camera) < tolerance
        assert np.array_equal(view.load_image(), frame.photo)
    for source, frame in zip(scene.depths or (), frames):
        depth = source.load()
        assert depth.dtype == np.float32 and (depth > 0).mean() > 0.97 and scene.depth_unit
        assert np.abs(depth / frame.depth - 1)[depth > 0].mean() < 2e-3
        assert source.digest == source.digest != scene.depths[0].digest or source is scene.depths[0]


@pytest.mark.parametrize("name", EXPORTS)
def test_what_systems_leave_next_to_files_is_not_read(name, frames, tmp_path):
    """macOS puts a ._file next to each on disks that are not its own; Windows Thumbs.db and desktop.ini."""
    EXPORTS[name](tmp_path, frames)
    own = [path for path in tmp_path.rglob("*") if path.is_file()]
    for path in own:
        for left in (f"._{path.name}", ".DS_Store", "Thumbs.db", "desktop.ini"):
            path.with_name(left).write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    scene = read(tmp_path, name)
    assert [len(scene.views), len(scene.depths or frames)] == [len(frames)] * 2
    assert all(source.load().any() for source in scene.depths or ())


def test_every_format_has_an_example():
    assert {name.split("-")[0] for name in EXPORTS} - {"mvsanywhere"} <= set(FORMATS)
    assert set(FORMATS) <= set(EXPORTS)


@pytest.mark.parametrize("kind", ["stretched", "padded", "cropped"])
def test_crop_and_padding_are_undone(kind, frames, tmp_path):
    way = next(w for w in placements((168, 126), (84, 84)) if w.kind == kind)
    small = [seen(frame, way, (84, 84)) for frame in frames]
    exports_depth.photos(tmp_path, frames, "photos")
    exports.colmap_bin(tmp_path / "sparse", exports_depth.photos(tmp_path, small))
    for view, frame in zip(read_scene(tmp_path, photos=tmp_path / "photos").views, frames):
        assert rigs.worst_difference(view.camera, frame.camera) < 1e-9
    depth = way.photo_depth(small[0].depth, 168, 126)
    valid = depth > 0
    assert np.abs(depth / frames[0].depth - 1)[valid].mean() < 2e-3
    assert valid.mean() == pytest.approx(0.75 if kind == "cropped" else 1, abs=0.02)


def test_photos_that_the_network_did_not_see_are_refused(frames, tmp_path):
    EXPORTS["da3"](tmp_path / "a", frames)
    Image.fromarray(frames[1].photo[::-1]).save(tmp_path / "a" / "images" / "000000.png")
    with pytest.raises(InputError, match="does not show 000000.png .*another order, or turned"):
        read_scene(tmp_path / "a")
    (tmp_path / "a" / "images" / "000002.png").unlink()
    with pytest.raises(InputError, match="3 cameras and .* 2 photos"):
        read_scene(tmp_path / "a")
    EXPORTS["da3-npy"](tmp_path / "b", frames)      # no images to compare with, and another shape
    for k in range(3):
        Image.fromarray(np.zeros((168, 84, 3), np.uint8)).save(tmp_path / "b" / "images" / f"{k:06d}.png")
    with pytest.raises(InputError, match="cropped or padded, and nothing says how"):
        read_scene(tmp_path / "b")


def test_without_photos_the_networks_own_are_refined(frames, tmp_path):
    EXPORTS["da3"](tmp_path, frames)
    shutil.rmtree(tmp_path / "images")
    scene = read_scene(tmp_path)
    assert scene.views[0].load_image().shape[:2] == scene.depths[0].load().shape == (28, 42)


@pytest.mark.parametrize("way, said", [(lambda photo: photo * 255, "runs from .* to .*, expected 0 to 1"),
                                       (lambda photo: photo * 2 - 1, "runs from -.* to .*, expected 0 to 1")])
def test_a_networks_own_photos_in_another_range_are_refused(way, said, frames, tmp_path):
    """They were cut to 0 to 1: white, or half of them black."""
    EXPORTS["vggt"](tmp_path, frames)
    shutil.rmtree(tmp_path / "images")
    arrays = dict(np.load(tmp_path / "predictions.npz"))
    np.savez(tmp_path / "predictions.npz", **{**arrays, "images": way(arrays["images"])})
    with pytest.raises(InputError, match=said):
        read_scene(tmp_path).views[0].load_image()
    resampled = np.interp(arrays["images"], [arrays["images"].min(), arrays["images"].max()], [-0.04, 1.04])
    np.savez(tmp_path / "predictions.npz", **{**arrays, "images": resampled.astype(np.float32)})
    shades = {shade for view in read_scene(tmp_path).views for shade in np.unique(view.load_image()).tolist()}
    assert {0, 255} <= shades


@pytest.mark.parametrize("name", ["da3", "mapanything", "mapanything-colmap", "nerfstudio", "record3d"])
def test_what_a_relative_path_has_read_is_found_from_other_folders(name, frames, tmp_path, monkeypatch):
    """Workers of a cluster are started in folders of their own."""
    EXPORTS[name](tmp_path / "scene", frames)
    monkeypatch.chdir(tmp_path)
    scene = read(Path("scene"), name)
    monkeypatch.chdir("/")
    for view, depth, frame in zip(scene.views, scene.depths or [None] * 9, frames):
        assert np.array_equal(view.load_image(), frame.photo) and (depth is None or depth.load().any())


def test_intrinsics_that_a_crop_method_left_small_are_refused(frames, tmp_path):
    views = exports_depth.photos(tmp_path, frames)
    exports.colmap_bin(tmp_path, [replace(v, camera=replace(v.camera, fx=v.camera.fx / 4, fy=v.camera.fy / 4,
                                                            cx=v.camera.cx / 4, cy=v.camera.cy / 4)) for v in views])
    with pytest.raises(InputError, match="crop method does not scale them back"):
        read_scene(tmp_path)


@pytest.mark.parametrize("name", ["da3", "vggt"])
@pytest.mark.parametrize("times", [2, 4, 0.25])
def test_a_networks_intrinsics_of_another_size_are_refused(name, times, frames, tmp_path):
    """Those of the photos next to small depth maps: cameras were said to be off by some pixels."""
    EXPORTS[name](tmp_path, frames)
    path = next(tmp_path.rglob("*.npz"))
    arrays = dict(np.load(path))
    key = next(key for key in arrays if key.startswith("intrinsic"))
    arrays[key][:, :2] *= times
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=r"principal points lie at .* of the network's images .*of another size"):
        read_scene(tmp_path)


def test_low_confidence_is_left_out_and_logged(frames, tmp_path, caplog):
    low = [replace(f, confidence=np.where(np.arange(168) < 42, 1, 3 + np.zeros((126, 168))).astype(np.float32))
           for f in frames]
    for name, threshold in {"da3": "1.5", "da3-npy": "1.5", "vggt": "1.5", "mapanything": "1.5", "polycam": "254",
                       "record3d": "2"}.items():
        EXPORTS[name](tmp_path / name, low)
        caplog.clear()
        with caplog.at_level(logging.INFO, "pagas_cl"):
            scene = read_scene(tmp_path / name)
        assert (scene.depths[0].load()[:, :36] == 0).all() and (scene.depths[0].load()[:, 48:] > 0).all(), name
        assert re.search(rf"confidence below {threshold}\) are left out, 2[3-7] %", caplog.text), name
    assert (read_scene(tmp_path / "da3", confidence=0.5).depths[0].load() > 0).all()


def test_what_mapanything_masks_is_left_out(frames, tmp_path):
    holed = [replace(f, depth=np.where(np.arange(168) < 42, 0, f.depth).astype(np.float32)) for f in frames]
    EXPORTS["mapanything"](tmp_path, holed)
    for path in (tmp_path / "predictions").iterdir():       # the network gives depth there, too
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, "depth_z": np.maximum(arrays["depth_z"], 1)})
    found = read_scene(tmp_path).depths[0].load()
    assert (found[:, :36] == 0).all() and (found[:, 48:] > 0).all()
    np.savez(path, **{**arrays, "mask": arrays["mask"][:, 1:]})
    with pytest.raises(InputError, match="mask.* has shape .*expected one"):
        read_scene(tmp_path).depths[-1].load()


def test_frames_without_a_pose_are_left_out(frames, tmp_path, caplog):
    EXPORTS["scannet"](tmp_path, frames)
    (tmp_path / "pose" / "1.txt").write_text("-inf " * 16)
    with caplog.at_level(logging.INFO, "pagas_cl"):
        assert [view.name for view in read_scene(tmp_path).views] == ["0.png", "2.png"]
    assert "1 of 3 frames have no pose" in caplog.text
    intrinsic = tmp_path / "intrinsic" / "intrinsic_color.txt"
    intrinsic.write_text(intrinsic.read_text().replace(intrinsic.read_text().split()[2], "inf"))
    with pytest.raises(InputError, match="intrinsic_color.txt.*'inf', expected a number"):
        read_scene(tmp_path)


def test_units_are_those_that_files_say(frames, tmp_path):
    EXPORTS["nerfstudio"](tmp_path, frames)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "depth_unit_scale_factor": 0.01}))
    assert read_scene(tmp_path).depths[0].load().max() == pytest.approx(10 * frames[0].depth.max(), rel=1e-3)


def test_units_are_those_that_open3ds_recordings_say(frames, tmp_path):
    """intrinsic.json of RGBDVideoReader: 4000 for a metre of RealSense's L515; it was read, and 1000 was taken."""
    EXPORTS["open3d"](tmp_path, frames)
    (tmp_path / "intrinsic.json").write_text(json.dumps({"depth_scale": 4000.0, "device_name": "L515"}))
    scene = read_scene(tmp_path)
    assert scene.depths[0].load().max() == pytest.approx(frames[0].depth.max() / 4, rel=1e-3)
    assert scene.depth_unit == "4000 for one scene unit, as intrinsic.json says"
    (tmp_path / "intrinsic.json").write_text('{"depth_scale": "metres"}')
    with pytest.raises(InputError, match="intrinsic.json: depth_scale is 'metres', expected a number"):
        read_scene(tmp_path)


def test_example_is_never_written_over_something(made, tmp_path):
    write_example(tmp_path / "new", "tum", made)
    with pytest.raises(InputError, match="is not empty"):
        write_example(tmp_path / "new", "tum", made)
    with pytest.raises(InputError, match="unknown format 'tom'"):
        write_example(tmp_path / "other", "tom", made)
    assert METRES < 0.01 and as_network(frames_of(made))[0].depth.shape == (126, 168)


@pytest.mark.parametrize("kind", ["npz", "npy"])
def test_a_batch_axis_of_one_is_taken(frames, tmp_path, kind):
    """VGGT's arrays as the network returns them, (1, photos, ...), for any number of photos, a single one too."""
    for count in (3, 1):
        plain, batch = tmp_path / f"plain{count}", tmp_path / f"batch{count}"
        for folder in (plain, batch):
            EXPORTS["vggt"](folder, frames[:count])
        arrays = {name: values[None] for name, values in np.load(batch / "predictions.npz").items()}
        (batch / "predictions.npz").unlink()
        if kind == "npz":
            np.savez(batch / "predictions.npz", **arrays)
        else:
            (batch / "vggt").mkdir()
            for name, values in arrays.items():
                np.save(batch / "vggt" / f"{name}.npy", values)
        one, other = read_scene(plain), read_scene(batch)
        assert len(one.views) == len(other.views) == count
        for k in range(count):
            assert rigs.worst_difference(one.views[k].camera, other.views[k].camera) == 0
            assert np.array_equal(one.depths[k].load(), other.depths[k].load())
            assert one.depths[k].least == other.depths[k].least


def test_masks_next_to_a_networks_photos_are_taken(frames, tmp_path):
    EXPORTS["da3"](tmp_path, frames)
    (tmp_path / "masks").mkdir()
    for k in range(3):
        Image.fromarray(np.eye(126, 168).astype(np.uint8) * 255).save(tmp_path / "masks" / f"{k:06d}.png")
    assert all(np.array_equal(view.load_mask(), np.eye(126, 168) > 0) for view in read_scene(tmp_path).views)
    for path in (tmp_path / "masks").iterdir():
        path.rename(path.with_stem(f"mask_of_{path.stem}"))
    with pytest.raises(InputError, match="no mask in .* belongs to any photo"):
        read_scene(tmp_path)


@pytest.mark.parametrize("arrays", [{"pts3d": 1, "focals": 1}, {"depthmaps": 1, "im_poses": 1}, None])
def test_what_dust3r_leaves_is_named(tmp_path, arrays):
    if arrays is None:
        (tmp_path / "scene.glb").write_bytes(b"glTF")
    else:
        np.savez(tmp_path / "output.npz", **arrays)
    with pytest.raises(InputError, match="DUSt3R or MASt3R found: save its depth maps .* predictions.npz"):
        read_scene(tmp_path)


@pytest.mark.parametrize("name, message", [
    ("scene.mvs", "OpenMVS's .mvs is not read"), ("cameras.xml", "Export Cameras"), ("cameras.sfm", "ExportColmap"),
    ("sfm_data.json", "openMVG2Colmap"), ("reconstruction.json", "opensfm export_colmap"),
    ("dataparser_transforms.json", "nerfstudio: give the folder that it was trained on")])
def test_what_another_program_leaves_is_named(tmp_path, name, message):
    (tmp_path / name).write_text("{}")
    with pytest.raises(InputError, match=message):
        read_scene(tmp_path)


def test_an_output_of_gaussian_splatting_names_what_to_give(tmp_path):
    """3DGS, 2DGS and PGSR leave cameras without principal points; cfg_args says what they were trained on."""
    camera = {"id": 0, "img_name": "a", "width": 4, "height": 3, "position": [0, 0, 0], "fx": 4, "fy": 4}
    (tmp_path / "cameras.json").write_text(json.dumps([{**camera, "rotation": np.eye(3).tolist()}]))
    (tmp_path / "cfg_args").write_text(f"Namespace(eval=False, model_path='out', source_path='{tmp_path}/data')")
    with pytest.raises(InputError, match=f"trained on, '{tmp_path}/data', and as --mesh the one that render.py"):
        read_scene(tmp_path)
    for place in ("train/ours_7000", "train/ours_30000"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "fuse_post.ply").touch()
    with pytest.raises(InputError, match=f"as --mesh '{tmp_path}/train/ours_30000/fuse_post.ply'$"):
        read_scene(tmp_path)


def test_what_is_left_out_is_logged(frames, tmp_path, caplog):
    """Cameras, photos, sequences, models and depth maps that a reader does not take."""
    def says(message, name, change, **options):
        EXPORTS[name](tmp_path / name, frames)
        change(tmp_path / name)
        caplog.clear()
        with caplog.at_level(logging.WARNING, "pagas_cl"):
            read_scene(tmp_path / name, **options)
        assert re.search(message, caplog.text), (name, caplog.text)

    def model(folder):
        exports.colmap_txt(folder / "sparse" / "1", exports_depth.photos(folder, frames))

    def fewer(folder):
        (folder / "depth" / "000000.png").unlink()
        for path in (folder / "depth").iterdir():
            path.rename(path.with_stem(f"other{path.stem}"))

    says("1 cameras without a photo, or photos without", "mvsnet", lambda f: next((f / "images").iterdir()).unlink())
    says("1 of its 3 cameras have no photo", "neus", lambda f: sorted((f / "image").iterdir())[-1].unlink())
    says("seq-02 are other sequences", "7scenes", lambda f: (f / "seq-02").mkdir())
    says("1 next to it are other models", "colmap", model)
    says("2 depth maps, none called as one of the 3 photos", "open3d", fewer)
