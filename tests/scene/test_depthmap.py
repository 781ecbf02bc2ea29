"""Depth maps on disk: every kind, damage, other sizes."""

import numpy as np
import pytest
from PIL import Image

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import (
    central_normals,
    central_normals_at,
    clean_depth,
    find_depth,
    load_depth,
    resize_depth,
    save_depth,
    stretched_depth,
)
from pagas_cl.system.files import sum_of, write_arrays


@pytest.fixture
def depth():
    rng = np.random.default_rng(0)
    return np.where(rng.random((6, 9)) > 0.3, rng.uniform(1, 5, (6, 9)), 0).astype(np.float32)


def colmap(path, values):
    height, width = values.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + values.astype("<f4").tobytes())


def pfm(path, values, order="<"):
    height, width = values.shape
    sign = "-1.0" if order == "<" else "1.0"
    path.write_bytes(f"Pf\n{width} {height}\n{sign}\n".encode() + values[::-1].astype(order + "f4").tobytes())


def test_round_trip_and_same_bytes(tmp_path, depth):
    save_depth(tmp_path / "new" / "a.npz", depth)
    save_depth(tmp_path / "b.npz", depth)
    assert np.array_equal(load_depth(tmp_path / "new" / "a.npz"), depth)
    with np.load(tmp_path / "b.npz") as archive:
        assert archive.files == ["depth"] and archive["depth"].dtype == np.float32
    assert (tmp_path / "new" / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["a.npz"]


def test_nothing_half_written_is_left(tmp_path):
    with pytest.raises(ValueError):
        save_depth(tmp_path / "a.npz", [["x"]])
    assert list(tmp_path.iterdir()) == []


def test_every_kind(tmp_path, depth):
    np.savez(tmp_path / "a.npz", whatever=depth.astype(np.float64))
    np.save(tmp_path / "a.npy", depth)
    pfm(tmp_path / "a.pfm", depth)
    pfm(tmp_path / "big.pfm", depth, ">")
    colmap(tmp_path / "a.png.geometric.bin", depth)
    for name in ("a.npz", "a.npy", "a.pfm", "big.pfm", "a.png.geometric.bin"):
        assert np.array_equal(load_depth(tmp_path / name), depth), name
    Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(tmp_path / "a.png")
    assert np.abs(load_depth(tmp_path / "a.png", scale=1000) - depth).max() < 5.1e-4
    with pytest.raises(InputError, match="does not say its unit"):
        load_depth(tmp_path / "a.png")


def test_what_could_not_be_read_again_is_not_saved(tmp_path, depth):
    for name in ("a.npy", "a.pfm", "a"):
        with pytest.raises(InputError, match=f"{name}': expected a name that ends in .npz"):
            save_depth(tmp_path / name, depth)
    with pytest.raises(InputError, match=r"a.npz' has shape \(2, 3, 4\), expected \(height, width\)"):
        save_depth(tmp_path / "a.npz", np.ones((2, 3, 4)))
    assert list(tmp_path.iterdir()) == []
    save_depth(tmp_path / "a.npz", depth[None, ..., None])
    assert np.array_equal(load_depth(tmp_path / "a.npz"), depth)
    with pytest.raises(InputError, match="depth scale is '1000', expected a number above 0"):
        load_depth(tmp_path / "a.npz", scale="1000")


def test_found_by_stem_and_by_whole_name(tmp_path, depth):
    colmap(tmp_path / "a.jpg.geometric.bin", depth)
    assert find_depth(tmp_path, "a.jpg").name == "a.jpg.geometric.bin"
    save_depth(tmp_path / "a.npz", depth)
    assert find_depth(tmp_path, "left/a.jpg").name == "a.npz"
    assert find_depth(tmp_path, "b.jpg") is None


def test_map_written_by_colmap(tmp_path, depth):
    pycolmap = pytest.importorskip("pycolmap")
    if not hasattr(pycolmap, "DepthMap"):
        pytest.skip("this pycolmap has no DepthMap to write one with")
    other = pycolmap.DepthMap.from_array(depth, 0.1, 100.0)
    other.write(str(tmp_path / "b.geometric.bin"))
    assert np.array_equal(load_depth(tmp_path / "b.geometric.bin"), depth)


def test_what_is_no_depth_becomes_zero():
    values = np.array([[1, np.nan, np.inf], [-np.inf, -2, 1e300]])
    assert clean_depth(values).tolist() == [[1, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize("name, content, message", [
    ("a.npz", b"PK\x03\x04 no", "cannot be read"), ("a.npy", b"\x93NUMPY", "cannot be read"),
    ("a.npz", b"", "cannot be read"),
    ("a.pfm", b"Pf\n9999999 9999999\n-1\nxx", "says 9999999 x 9999999"), ("a.pfm", b"PF\n1 1\n-1\n", "one channel"),
    ("a.pfm", b"", "no PFM header"), ("a.geometric.bin", b"5&5&1&abc", "100 bytes, and 3 follow"),
    ("a.geometric.bin", b"5&5&3&" + b"0" * 300, "3 channels"), ("a.geometric.bin", b"-5&5&1&", "header"),
    ("a.txt", b"1", "unknown kind"),
])
def test_damage_is_reported_in_one_sentence(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        load_depth(tmp_path / name)
    assert name in str(error.value) and "\n" not in str(error.value)


def test_pickles_are_not_run(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        load_depth(tmp_path / "a.npy")
    with pytest.raises(InputError, match="does not exist"):
        load_depth(tmp_path / "b.npy")


@pytest.mark.parametrize("size", [(18, 12), (9, 12), (20, 13), (4, 3), (3, 7)])
def test_resizing_keeps_validity_and_values_in_range(depth, size):
    got = stretched_depth(depth, *size)
    assert got.shape == size[::-1] and got.dtype == np.float32
    valid = got > 0
    assert got[valid].min() >= depth[depth > 0].min() - 1e-6 and got.max() <= depth.max() + 1e-6
    if size[0] >= 9 and size[1] >= 6:
        rows = ((np.arange(size[1]) + 0.5) * 6 / size[1]).astype(int)
        columns = ((np.arange(size[0]) + 0.5) * 9 / size[0]).astype(int)
        assert np.array_equal(valid, (depth > 0)[rows][:, columns])


@pytest.mark.parametrize("size", [(17, 13), (20, 15), (80, 60), (40, 30)])
def test_resizing_takes_infinity_for_no_surface(size):
    """One pixel of it made all that lies right of it and below NaN."""
    depth, holed = np.full((30, 40), 2, np.float32), np.full((30, 40), 2, np.float32)
    depth[3, 5], holed[3, 5] = np.inf, 0
    assert np.array_equal(resize_depth(depth, *size), resize_depth(holed, *size)) and np.isinf(depth[3, 5])


def test_resizing_a_plane_is_exact_inside():
    y, x = np.mgrid[:12, :16] + 0.5
    plane = (5 + 0.1 * x + 0.2 * y).astype(np.float32)
    y, x = np.mgrid[:24, :32] / 2 + 0.25
    want = 5 + 0.1 * x + 0.2 * y
    assert np.abs(resize_depth(plane, 32, 24) - want)[1:-1, 1:-1].max() < 1e-5


def test_normals_of_some_pixels_are_those_of_the_whole_map():
    rng, camera = np.random.default_rng(0), Camera(40, 30, 35.3, 34.0, 20.2, 14.1, np.eye(4))
    depth = rng.uniform(1, 1.1, (30, 40)).astype(np.float32)
    depth[rng.uniform(size=depth.shape) < 0.1] = 0
    rows, columns = (part.ravel() for part in np.mgrid[:30, :40])
    some = central_normals_at(depth, camera, rows, columns)
    whole = central_normals(depth, camera)[rows, columns]
    assert np.isfinite(some).any() and np.array_equal(some, whole, equal_nan=True)


def test_real_sensor_depth(data_dir):
    path = find_depth(data_dir / "hololens_rgbd" / "depth", "00010.png")
    depth = load_depth(path, (540, 360), scale=1000)
    assert depth.shape == (360, 540) and 0.5 < np.median(depth[depth > 0]) < 8 and 0.3 < (depth > 0).mean() < 0.9


def test_archives_are_those_of_numpy_and_show_damage(tmp_path):
    arrays = {"depth": np.arange(12, dtype=np.float32).reshape(3, 4), "none": np.zeros((0, 2)), "one": np.array(3.0)}
    np.savez(tmp_path / "numpy.npz", **arrays)
    with open(tmp_path / "written.npz", "wb") as file:
        found = write_arrays(file, arrays)
    whole = (tmp_path / "written.npz").read_bytes()
    assert whole == (tmp_path / "numpy.npz").read_bytes() and found == sum_of(tmp_path / "written.npz")
    at = whole.index(arrays["depth"].tobytes()) + 5
    (tmp_path / "written.npz").write_bytes(whole[:at] + b"?" + whole[at + 1:])
    assert found != sum_of(tmp_path / "written.npz")
