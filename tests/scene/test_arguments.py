"""Arguments of the Python calls that are of a wrong kind: one InputError sentence that names the argument, what was
given and what is expected; and kinds that are taken."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import look_at
from PIL import Image

import pagas_cl
from pagas_cl.app.report import write_mesh_page
from pagas_cl.errors import InputError
from pagas_cl.scene.images import as_photo
from pagas_cl.scene.inputs import as_cameras, as_views, depth_maps, requested_views
from pagas_cl.scene.readers.meshlab import write_project
from pagas_cl.scene.view import Scene, View

DEPTH = np.ones((4, 6), np.float32)
CAMERAS = [look_at((x, 0, -5), (0, 0, 0), 6, 4, 5.0) for x in range(3)]
PHOTOS = [np.full((4, 6, 3), 9 * k, np.uint8) for k in range(3)]
VIEWS = [View(camera, photo, name=f"{k}.png") for k, (camera, photo) in enumerate(zip(CAMERAS, PHOTOS))]
GOOD = {
    "refine_mesh": {"mesh": ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "cams": CAMERAS, "images": PHOTOS},
    "refine_views": {"views": VIEWS, "depths": [DEPTH] * 3},
    "refine_depth": {"target": VIEWS[0], "contexts": VIEWS[1:], "depth": DEPTH},
}
OPTIONS = {
    "refine_mesh": ["masks", "preset", "config", "device", "output", "subdivide", "tolerance", "triangles",
                    "executor", "folder"],
    "refine_views": ["names", "config", "preset", "device", "on_view", "executor", "folder", "progress"],
    "refine_depth": ["preset", "config", "device", "held_out", "photos"],
}
WRONG = {"number": 3, "object": object(), "numbers": [3, 4, 5], "dict": {"a": 1}, "cameras": CAMERAS, "photos": PHOTOS,
         "views": VIEWS, "scene": Scene(VIEWS), "array": np.ones((3, 4, 6)), "strings": ["x", "y", "z"],
         "nothing": None, "image": Image.fromarray(PHOTOS[0])}
# what is right after all, or found wrong for what it holds and not for its kind
RIGHT = {("views", "views"), ("contexts", "views"), ("held_out", "views"), ("cams", "cameras"), ("images", "photos"),
         ("masks", "photos"), ("device", "strings"), ("images", "strings"), ("masks", "strings"), ("names", "strings"),
         ("masks", "array"), ("names", "dict"), ("depths", "array"), ("subdivide", "number"), ("tolerance", "number"),
         ("triangles", "number"),
         ("depth", "image"), ("masks", "cameras")}
CASES = [(call, argument, kind) for call in GOOD for argument in [*GOOD[call], *OPTIONS[call]] for kind in WRONG
         if (argument, kind) not in RIGHT and not (kind == "nothing" and argument in OPTIONS[call])]


@pytest.mark.parametrize("call, argument, kind", CASES)
def test_a_wrong_kind_is_named(call, argument, kind):
    with pytest.raises(InputError) as error:
        getattr(pagas_cl, call)(**{**GOOD[call], argument: WRONG[kind]})
    said = str(error.value)
    assert argument.rstrip("s") in said and "expected" in said and "\n" not in said and len(said) < 500, said


def test_a_name_of_a_wrong_kind_is_named():
    with pytest.raises(InputError, match=r"names\[1\] is an int, expected the name of a view"):
        pagas_cl.refine_views(**{**GOOD["refine_views"], "names": [VIEWS[0].name, 3]})


@pytest.mark.parametrize("call, sentence", [
    (lambda: pagas_cl.read_scene(None), "folder is None, expected a path"),
    (lambda: pagas_cl.read_scene(".", ["colmap"]), r"unknown format \['colmap'\], expected one of"),
    (lambda: pagas_cl.read_scene(__file__), "holds no cameras in .*; give the folder that this file is in"),
    (lambda: pagas_cl.find_depth(3, "a.png"), "folder is an int, expected a path"),
    (lambda: pagas_cl.find_depth(".", None), "image_name is None, expected a path"),
    (lambda: pagas_cl.load_depth([DEPTH]), "path is a list, expected a path"),
    (lambda: pagas_cl.load_depth("a.npz", 6), r"size is 6, expected \(width, height\)"),
    (lambda: pagas_cl.save_depth(DEPTH, "a.npz"), "path is an array of float32, expected a path"),
    (lambda: write_mesh_page(None, *2 * [GOOD["refine_mesh"]["mesh"]]), "path is None, expected a path"),
    (lambda: write_project(None, VIEWS), "path is None, expected a path"),
    (lambda: write_project("a.mlp", CAMERAS), r"views\[0\] is a Camera, expected a list of pagas_cl.View"),
    (lambda: write_project("a.mlp", [], ["a.ply"]), r"meshes\[0\] is a str, expected a list of MeshLayer"),
    (lambda: Scene(None), "views is None, expected a list of pagas_cl.View"),
    (lambda: replace(CAMERAS[0], name=3), "name of a camera is an int, expected text"),
    (lambda: pagas_cl.align_depth_scales(None, [DEPTH]), "views is None, expected a list of pagas_cl.View"),
    (lambda: pagas_cl.Surface(None, [[0, 1, 2]]), "vertices is None, expected an array of numbers"),
    (lambda: pagas_cl.Surface(np.eye(3) * 1j, [[0, 1, 2]]), "vertices is an array of complex128, expected an array"),
    (lambda: pagas_cl.Surface(np.eye(3), [[0, 1, 2]], colors="red"), "colors is a str, expected an array of numbers"),
    (lambda: pagas_cl.preset("fast").with_settings(splatting__radius=np.ones((2, 2))), "splatting.radius is array"),
    (lambda: as_cameras(np.arange(3)), r"cams\[0\] is an int64, expected a list of"),
])
def test_other_calls_name_a_wrong_kind(call, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        call()
    assert "\n" not in str(error.value)


def test_views_of_a_generator_are_taken():
    assert Scene(view for view in VIEWS).views == VIEWS
    assert len(pagas_cl.align_depth_scales((view for view in VIEWS), (None for _ in VIEWS)).factors) == 3
    with pytest.raises(InputError, match="2 depth maps were given for 3 views"):
        pagas_cl.tradeoff((view for view in VIEWS), [DEPTH] * 2)


def test_cameras_and_photos_that_were_swapped():
    with pytest.raises(InputError, match=r"cams\[0\] is an array of uint8, .*were cams and images swapped\?"):
        pagas_cl.refine_mesh(GOOD["refine_mesh"]["mesh"], PHOTOS, CAMERAS)
    with pytest.raises(InputError, match=r"images\[0\] is a Camera, .*were cams and images swapped\?"):
        as_views(CAMERAS, CAMERAS)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "CMYK", "I;16"])
def test_pillow_images_are_photos_and_masks(mode):
    rng = np.random.default_rng(0)
    colours = Image.fromarray(rng.integers(0, 256, (4, 6, 3), np.uint8))
    wide = Image.fromarray(rng.integers(0, 65536, (4, 6)).astype(np.uint16))
    given = wide if mode == "I;16" else colours.convert(mode)
    (view,) = as_views(CAMERAS[:1], [given], [Image.fromarray(np.eye(4, 6) > 0)])
    assert view.load_image().shape == (4, 6, 3) and view.load_image().dtype == np.uint8
    assert np.array_equal(view.load_mask(), np.eye(4, 6) > 0)
    if mode == "RGB":
        assert np.array_equal(view.load_image(), np.asarray(colours))


def test_a_pillow_image_is_a_depth_map():
    found = depth_maps(VIEWS[:1], [Image.fromarray(DEPTH)])[0]
    assert np.array_equal(found, DEPTH)


@pytest.mark.parametrize("kind", ["legacy", "tensor image", "tensor"])
def test_images_of_open3d_are_photos_masks_and_depth_maps(kind):
    """Its tensors have a load(), which was called; its tensor images have a third axis, of which one was refused."""
    o3d = pytest.importorskip("open3d")
    made = {"legacy": o3d.geometry.Image, "tensor": o3d.core.Tensor,
            "tensor image": lambda pixels: o3d.t.geometry.Image(o3d.core.Tensor(pixels))}[kind]
    (view,) = as_views(CAMERAS[:1], [made(PHOTOS[1])], [made(np.eye(4, 6, dtype=np.uint8) * 255)])
    assert np.array_equal(view.load_image(), PHOTOS[1]) and np.array_equal(view.load_mask(), np.eye(4, 6) > 0)
    assert np.array_equal(depth_maps(VIEWS[:1], [made(DEPTH)])[0], DEPTH)


def test_lists_of_open3d_cameras_are_cameras():
    o3d = pytest.importorskip("open3d")
    given = o3d.camera.PinholeCameraTrajectory()
    each = []
    for camera in CAMERAS:
        own = o3d.camera.PinholeCameraParameters()
        own.intrinsic = o3d.camera.PinholeCameraIntrinsic(6, 4, camera.fx, camera.fy, camera.cx, camera.cy)
        own.extrinsic = camera.world_to_camera
        each.append(own)
    given.parameters = each
    for one, other in zip(as_cameras(each), as_cameras(given)):
        assert np.array_equal(one.K, other.K) and np.array_equal(one.world_to_camera, other.world_to_camera)
        assert one.name == other.name


def test_a_folder_of_masks_is_read_as_that_of_a_scene(tmp_path, caplog):
    """COLMAP's name.jpg.png, name.png, and the very name."""
    named = [replace(camera, name=name) for camera, name in zip(CAMERAS, ("left/a.jpg", "b.jpg", "c.png"))]
    (tmp_path / "left").mkdir()
    files = [tmp_path / name for name in ("left/a.jpg.png", "b.png", "c.png")]
    for row, file in enumerate(files):
        Image.fromarray(np.uint8(255) * (np.arange(24).reshape(4, 6) // 6 == row)).save(file)
    views = as_views(named, PHOTOS[:len(named)], tmp_path)
    assert [view.mask for view in views] == files
    assert [int(np.flatnonzero(view.load_mask().all(1))[0]) for view in views] == [0, 1, 2]
    assert Scene(views).masks == files
    files[1].unlink()
    views = as_views(named, PHOTOS[:len(named)], tmp_path)
    assert [view.mask for view in views] == [files[0], None, files[2]]
    assert "1 of 3 views have no mask in" in caplog.text and "'b.jpg'" in caplog.text
    with pytest.raises(InputError, match="images: .* lacks 1 of the 2 photos, such as 'd.png': copy them there"):
        as_views([replace(CAMERAS[0], name="d.png"), named[2]], tmp_path)


def test_photos_in_no_order_or_another_one_are_refused(tmp_path):
    named = [replace(camera, name=f"{name}.png") for camera, name in zip(CAMERAS, "abc")]
    files = [tmp_path / "small" / f"{name}.jpg" for name in "bac"]
    with pytest.raises(InputError, match=r"images\[0\] is .*b.jpg' and camera 0 is called 'a.png': expected images in "
                                         "the order of the cameras"):
        as_views(named, files)
    assert [view.image for view in as_views(named, dict(zip(["a.png", "b.png", "c.png"], files)))] == files
    assert [view.image for view in as_views(named, [*files[:2], tmp_path / "z.jpg"])][:2] == files[:2]
    for cameras, photos in ((set(CAMERAS), PHOTOS), (CAMERAS, set(map(str, files)))):
        with pytest.raises(InputError, match="is a set, expected a list"):
            as_views(cameras, photos)


def test_names_are_of_views_that_have_a_depth_map():
    for names in ({"2.png", "1.png"}, ["1.png", "2.png", "1.png"]):
        assert requested_views(VIEWS, [None, DEPTH, DEPTH], names) == [1, 2]
    for names, what in (([], "names is empty"), (["1.png", "0.png"], "names has '0.png', a view without a depth map")):
        with pytest.raises(InputError, match=what):
            requested_views(VIEWS, [None, DEPTH, DEPTH], names)


class OnAnotherDevice:
    """A tensor that is no array as it is."""

    def __array__(self, dtype=None, copy=None):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")


def test_what_a_tensor_says_is_passed_on():
    with pytest.raises(InputError, match=r"image of view '00000' is no array \(can't convert cuda:0 .*Tensor.cpu"):
        as_views(CAMERAS, [OnAnotherDevice()] * 3)
    with pytest.raises(InputError, match=r"depths\[0\], the depth map of view '0.png', is no array .*Tensor.cpu"):
        depth_maps(VIEWS, [OnAnotherDevice()] * 3)


def test_a_masked_array_is_refused():
    with pytest.raises(InputError, match=r"is a masked array, .*filled\(0\)"):
        depth_maps(VIEWS[:1], [np.ma.masked_less(DEPTH, 2)])


def test_16_bit_photos_of_either_byte_order_and_with_8_bit_numbers():
    wide = np.arange(72, dtype=np.uint16).reshape(4, 6, 3) * 257
    assert np.array_equal(as_photo(wide.astype(">u2")), wide // 257)
    with pytest.raises(InputError, match="photo 3 is 16-bit and runs to 71, expected 65535 for white; pass uint8"):
        as_photo(wide // 257, "photo 3")
    assert not as_photo(np.zeros((4, 6, 3), np.uint16)).any()


def test_of_a_reconstruction_the_images_with_a_pose_are_cameras():
    pycolmap = pytest.importorskip("pycolmap")
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(model="PINHOLE", width=6, height=4, params=[5, 5, 3, 2],
                                                     camera_id=1))
    for k, name in enumerate("cab", 1):
        pose = [] if name == "b" else [pycolmap.Rigid3d(np.eye(4)[:3])]
        made.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=k), *pose)
    assert [camera.name for camera in as_cameras(made)] == ["a", "c"]
