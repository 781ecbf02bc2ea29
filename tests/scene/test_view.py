"""View, Scene, photos and masks: what comes in, what is refused and how."""

import numpy as np
import pytest
from PIL import Image

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import as_mask, as_photo, photo_to, read_mask, read_photo
from pagas_cl.scene.inputs import as_views, depth_array
from pagas_cl.scene.view import Scene, View


def camera(width=20, height=10, name="a.png"):
    return Camera(width, height, 15, 15, width / 2, height / 2, np.eye(4), name)


@pytest.fixture
def photo():
    return np.random.default_rng(0).integers(0, 256, (10, 20, 3), dtype=np.uint8)


def test_file_and_array_give_the_same_bytes(tmp_path, photo):
    Image.fromarray(photo).save(tmp_path / "a.png")
    for source in (photo, tmp_path / "a.png", str(tmp_path / "a.png"), photo / 255.0, (photo / 255).astype("f4")):
        assert np.array_equal(View(camera(), source).load_image(), photo)


def test_other_kinds_of_photos(tmp_path, photo):
    grey = photo[..., 0]
    assert np.array_equal(as_photo(grey), np.repeat(grey[..., None], 3, 2))
    assert np.array_equal(as_photo(photo.astype(np.uint16) * 257), photo)
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "wide.png")
    assert np.array_equal(read_photo(tmp_path / "wide.png")[..., 1], grey)
    Image.fromarray(np.dstack([photo, grey]), "RGBA").save(tmp_path / "rgba.png")
    assert np.array_equal(read_photo(tmp_path / "rgba.png"), photo)


class Loaded:
    """Stands for an array."""

    def __init__(self, values):
        self.values = values

    def load(self):
        return self.values


def test_what_is_loaded_is_taken_as_an_array_is(photo):
    mask = np.uint8(255) * (photo[..., 0] > 99)
    for values in (photo, photo / 255, photo.astype(np.uint16) * 257):
        view = View(camera(), Loaded(values), Loaded(mask))
        assert np.array_equal(view.load_image(), photo) and view.load_image().dtype == np.uint8
        assert np.array_equal(view.load_mask(), photo[..., 0] > 99)
    with pytest.raises(InputError, match="image of view 'a.png' is a str, expected an array"):
        View(camera(), Loaded("photo")).load_image()
    for values in (np.ones((10, 20, 1)), None):
        with pytest.raises(InputError, match=r"a depth map that was loaded .*expected .*\(height, width\)"):
            depth_array(Loaded(values))


def test_a_pillow_image_that_cannot_be_decoded(tmp_path, photo):
    Image.fromarray(photo).save(tmp_path / "a.png")
    given = Image.open(tmp_path / "a.png")
    given.close()
    with pytest.raises(InputError, match="image of view 'a.png' cannot be decoded .*still open"):
        View(camera(), given)


def test_a_folder_without_files_of_the_cameras_names(tmp_path, photo):
    Image.fromarray(photo).save(tmp_path / "a.png")
    assert as_views([camera()], tmp_path)[0].image == tmp_path / "a.png"
    with pytest.raises(InputError, match="has no file that is called as a camera is, such as 'a': give"):
        as_views([camera(name="a")], tmp_path)


def test_exif_orientation_is_not_applied(tmp_path, photo):
    image = Image.fromarray(photo)
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "turned.png", exif=exif)
    assert read_photo(tmp_path / "turned.png").shape == (10, 20, 3)


def test_a_tiff_file_with_an_orientation_is_refused(tmp_path, photo):
    for value in (0, 1, 3, 6):
        image = Image.fromarray(photo)
        image.getexif()[0x0112] = value
        image.save(tmp_path / f"{value}.tif", exif=image.getexif())
    assert all(np.array_equal(read_photo(tmp_path / name), photo) for name in ("0.tif", "1.tif"))
    for value in (3, 6):
        with pytest.raises(InputError, match=rf"{value}.tif' has {value} in its tag Orientation, expected 1"):
            View(camera(), tmp_path / f"{value}.tif").check_files()


@pytest.mark.parametrize("name", ["small.jpg", "small.png"])
def test_small_photos_are_in_the_place_of_large_ones(tmp_path, name):
    """Decoded smaller or not, of a size that no eighth divides: its content stays where it is."""
    y, x = np.mgrid[:387, :523].astype(np.float32)
    waves = 128 + 60 * np.sin(x / 31) * np.cos(y / 23)
    Image.fromarray(np.stack([waves] * 3, -1).astype(np.uint8)).save(tmp_path / name, quality=95)
    view, sizes = View(camera(523, 387), tmp_path / name), [(101, 77), (40, 30)]
    for small, size in zip(view.load_small(sizes), sizes):
        assert small.shape == (*size[::-1], 3) and small.dtype == np.uint8
        assert np.abs(small.astype(float) - photo_to(view.load_image(), *size)).max() < 3
    with pytest.raises(InputError, match="is 523 x 387"):
        View(camera(500, 387), tmp_path / name).load_small(sizes)


@pytest.mark.parametrize("pixels, message", [
    (np.zeros((4, 4, 2), np.uint8), r"shape \(4, 4, 2\)"), (np.zeros((0, 4, 3), np.uint8), "shape"),
    (np.full((2, 2, 3), 200.0), "0 to 1; divide by 255"), (np.full((2, 2, 3), np.nan), "not finite"),
    (np.zeros((2, 2, 3), np.int64), "dtype int64"), (np.array(["x"]), "shape"),
])
def test_bad_arrays_are_refused(pixels, message):
    with pytest.raises(InputError, match=message):
        as_photo(pixels, "image 'x'")


def test_it_is_said_that_twelve_bits_in_sixteen_are_hardly_any_in_eight(caplog):
    full = np.linspace(0, 65535, 12).reshape(3, 4).astype(np.uint16)
    assert as_photo(full).max() == 255 and not caplog.records
    assert as_photo(full // 16, "image 'a.png'").max() == 16
    assert "'a.png' has 16 bits and no value above 4095 of 65535, of which 8 bits keep 17 levels" in caplog.text


def test_size_mismatch_names_both_sizes_and_the_remedy(photo):
    with pytest.raises(InputError, match=r"is 20 x 10, its camera says 40 x 20: .* times 0.5; .*resized\(20, 10\)"):
        View(camera(40, 20), photo)
    with pytest.raises(InputError, match="its camera says 10 x 20: the shapes differ.*: save the photo with its"):
        View(camera(10, 20), photo)
    with pytest.raises(InputError, match="mask 'a.png' is 3 x 4, its camera says 20 x 10"):
        View(camera(), photo, np.ones((4, 3), bool))


def test_size_mismatch_of_files_is_found_from_the_header(tmp_path, photo):
    Image.fromarray(photo).save(tmp_path / "a.png")
    Image.fromarray(photo[:5, :, 0]).save(tmp_path / "m.png")
    with pytest.raises(InputError, match="image 'a.png' is 20 x 10, its camera says 40 x 20"):
        View(camera(40, 20), tmp_path / "a.png").check_files()
    with pytest.raises(InputError, match="m.png' of view 'a.png' is 20 x 5"):
        View(camera(), tmp_path / "a.png", tmp_path / "m.png").check_files()
    with pytest.raises(InputError, match="image 'a.png' is 20 x 10"):
        View(camera(40, 20), tmp_path / "a.png").load_image()


def test_missing_and_damaged_files(tmp_path, photo):
    with pytest.raises(InputError, match="nowhere.png' does not exist"):
        View(camera(), tmp_path / "nowhere.png").load_image()
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(InputError, match="text.png' cannot be read"):
        read_photo(tmp_path / "text.png")
    big = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    Image.fromarray(big).save(tmp_path / "whole.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:20000])
    with pytest.raises(InputError, match="cut.png' cannot be decoded.*damaged or cut off"):
        read_photo(tmp_path / "cut.png")
    with pytest.raises(InputError, match="is not a file"):
        read_photo(tmp_path)


@pytest.mark.parametrize("name, options", [("a.jpg", {}), ("a.jpg", {"progressive": True}), ("a.png", {})])
def test_a_photo_that_is_cut_off_is_found(tmp_path, name, options):
    big = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    view = View(camera(300, 200), tmp_path / name)
    Image.fromarray(big).save(view.image, **options)
    whole = view.image.read_bytes()
    for content in (whole, whole + bytes(100)):     # zeros that a program has put behind it
        view.image.write_bytes(content)
        view.check_files(whole=True)
    for share in (0.5, 0.99):
        view.image.write_bytes(whole[:int(share * len(whole))])
        with pytest.raises(InputError, match=f"{name}' cannot be decoded.*damaged or cut off"):
            view.check_files(whole=True)


def test_masks(tmp_path):
    truth = np.array([[True, False], [False, True]])
    for values in (truth, truth * 1, truth * np.uint8(255), truth * 1.0, np.dstack([truth * np.uint8(255)] * 3)):
        assert np.array_equal(as_mask(values), truth)
    assert np.array_equal(as_mask(np.array([[0, 127, 128, 255]], np.uint8)), [[False, False, True, True]])
    for dtype in (np.uint16, np.int16, ">u2"):       # 8-bit numbers in 16 bits were all below half of the range
        assert np.array_equal(as_mask((truth * 255).astype(dtype)), truth)
        assert np.array_equal(as_mask(np.array([[0, 300, np.iinfo(dtype).max]], dtype)), [[False, False, True]])
    Image.fromarray(truth * np.uint8(255)).convert("1").save(tmp_path / "one.png")
    assert np.array_equal(read_mask(tmp_path / "one.png"), truth)
    rgba = np.zeros((2, 2, 4), np.uint8)
    rgba[..., 3] = truth * 255
    Image.fromarray(rgba).save(tmp_path / "alpha.png")
    assert np.array_equal(read_mask(tmp_path / "alpha.png"), truth)
    with pytest.raises(InputError, match="shape"):
        as_mask(np.zeros(4))


def test_scene_finds_views_by_name_and_stem(photo):
    scene = Scene([View(camera(name=f"left/{i}.png"), photo) for i in range(3)], "made")
    assert scene.index("left/1.png") == scene.index("1.png") == scene.index("1") == 1
    with pytest.raises(InputError, match="no view 'left/1.pgn'.*did you mean"):
        scene.index("left/1.pgn")
    with pytest.raises(InputError) as caught:
        scene.index("nope")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(InputError, match="2 views are called 'a.png'"):
        Scene([View(camera(), photo)] * 2)
