"""Depth maps that cannot be of their photo, in every format: refused by the header, before anything is decoded."""

import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest
from conftest import look_at
from PIL import Image
from support.example_scenes import frames_of
from support.exports_depth import EXPORTS
from support.fuzzing import bounded

import pagas_cl
from pagas_cl.errors import InputError, MissingExtraError
from pagas_cl.scene.depth.formats import FORMATS, read_values, stored_shape
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.depthmap import load_depth, resize_depth
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import View

PHOTO = (40, 30)
HUGE = (5000, 6000)


def npy_header(shape):
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + text.ljust(117).encode() + b"\n"


def write_npz(path, shape, values=None):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("depth.npy", "w",
                                                                                   force_zip64=True) as member:
        member.write(npy_header(shape))
        if values is not None:
            member.write(np.ascontiguousarray(values, "<f4").tobytes())
        for _ in range(shape[0] if values is None else 0):
            member.write(bytes(4 * shape[1]))


def sparse(path, header, count):
    """A file of `count` bytes behind its header, which take no place on the disk."""
    with open(path, "wb") as file:
        file.write(header)
        file.truncate(len(header) + count)


def write_npy(path, shape, values=None):
    if values is None:
        return sparse(path, npy_header(shape), 4 * shape[0] * shape[1])
    np.save(path, np.asarray(values, np.float32))


def write_pfm(path, shape, values=None):
    head = b"Pf\n%d %d\n-1.0\n" % shape[::-1]
    if values is None:
        return sparse(path, head, 4 * shape[0] * shape[1])
    path.write_bytes(head + np.ascontiguousarray(values[::-1], "<f4").tobytes())


def write_colmap(path, shape, values=None):
    head = b"%d&%d&1&" % shape[::-1]
    if values is None:
        return sparse(path, head, 4 * shape[0] * shape[1])
    path.write_bytes(head + np.ascontiguousarray(values, "<f4").tobytes())


def write_png(path, shape, values=None):
    if values is not None:
        return Image.fromarray(np.asarray(values, np.uint16)).save(path)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, parts = zlib.compressobj(1), []
    for _ in range(shape[0]):
        parts.append(packer.compress(bytes(1 + 2 * shape[1])))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", *shape[::-1], 16, 0, 0, 0, 0))
                     + chunk(b"IDAT", b"".join(parts) + packer.flush()) + chunk(b"IEND", b""))


def write_exr(path, shape, values=None):
    exr = pytest.importorskip("OpenEXR")
    values = np.zeros((shape[0] // 4, shape[1] // 4), np.float32) if values is None else values
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage},
                  {"Z": np.ascontiguousarray(values, np.float32)}) as file:
        file.write(str(path))


WRITERS = {".npz": write_npz, ".npy": write_npy, ".pfm": write_pfm, ".exr": write_exr, ".png": write_png,
           ".bin": write_colmap}


def name_of(kind):
    return f"a{'.png.geometric' if kind == '.bin' else ''}{kind}"


def test_every_format_is_tried():
    assert set(WRITERS) == set(FORMATS)


@pytest.mark.parametrize("kind", WRITERS)
def test_far_more_pixels_than_the_photo(tmp_path, kind):
    """Of 30 million pixels (2 in .exr, which has to be encoded): not decoded, for which there is no memory."""
    path = tmp_path / name_of(kind)
    WRITERS[kind](path, HUGE)
    for read in (lambda: load_depth(path, PHOTO, scale=1.0), DepthSource(path, PHOTO).check,
                 DepthSource(path, PHOTO).load):
        with bounded(2.0, 64 << 20), pytest.raises(InputError, match="more than 100 times the pixels") as error:
            read()
        assert path.name in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("kind", WRITERS)
def test_maps_that_fit_are_read_and_others_named(tmp_path, kind):
    path, depth = tmp_path / name_of(kind), np.add.outer(np.arange(60), np.arange(80.0)) + 2
    WRITERS[kind](path, depth.shape, depth)
    assert stored_shape(path) == (60, 80) and np.array_equal(read_values(path), depth)
    assert load_depth(path, PHOTO, scale=1.0).shape == PHOTO[::-1]
    with pytest.raises(InputError, match="80 x 60 .* its photo is 30 x 40, of another shape: it is transposed"):
        load_depth(path, (30, 40), scale=1.0)
    with pytest.raises(InputError, match="80 x 60 .* its photo is 50 x 30, .*: it was cropped or belongs to another"):
        DepthSource(path, (50, 30)).load()


@pytest.mark.parametrize("size", [(504, 378), (504, 336), (518, 350), (1038, 777), (256, 192), (161, 120), (3, 2)])
def test_what_networks_and_rounding_do_to_the_shape_is_taken(size):
    photo = {504: (4000, 3000) if size[1] == 378 else (3024, 2016)}.get(size[0], (1000 * size[0] // size[1], 1000))
    assert resize_depth(np.ones(size[::-1], np.float32), *photo[:1], photo[1]).shape == photo[::-1]
    turned = np.ones(size, np.float32)
    if min(size) > 20:
        with pytest.raises(InputError, match="is transposed"):
            resize_depth(turned, *photo)


def test_arrays_in_memory_are_compared_with_their_photo():
    views = [View(look_at((x, 0, -5), (0, 0, 0), *PHOTO, 40.0), np.zeros((30, 40, 3), np.uint8), name=f"{x}.png")
             for x in range(2)]
    with pytest.raises(InputError, match="0.png.* has shape \\(40, 30\\), its photo \\(30, 40\\); it is transposed"):
        pagas_cl.refine_depth(views[0], views[1:], np.ones((40, 30), np.float32))


@pytest.mark.parametrize("name", ["da3", "da3-npy", "vggt", "mapanything", "record3d", "polycam", "tum", "nerfstudio",
                                  "open3d", "scannet", "7scenes", "dvmvs", "record3d-exr"])
def test_formats_with_depth_are_refused_before_the_run(tmp_path, name):
    """Each format's depth maps, of photos that became a hundredth of the size: refused by the headers alone."""
    from support.scenes import relief_scene

    if name == "record3d-exr":
        pytest.importorskip("OpenEXR")
    EXPORTS[name](tmp_path, frames_of(relief_scene(168, 126, 2, held_out=0)))
    scene = read_scene(tmp_path)
    depths = [DepthSource(d.file, (2, 2), d.scale, d.placement, d.confidence, d.least, d.invalid)
              for d in scene.depths]
    views = [View(look_at((x, 0, -5), (0, 0, 0), 2, 2, 40.0), np.zeros((2, 2, 3), np.uint8), name=f"{x}.png")
             for x in range(len(depths))]
    with pytest.raises(InputError, match="more than 100 times the pixels"):
        pagas_cl.refine_views(views, depths)


def test_the_command_line_refuses_it(tmp_path):
    """A scene whose depth maps of 100 KB would be 120 MB each: status 2, one sentence, nothing written."""
    from support.scenes import relief_scene
    from support.synthetic.scene import write_scene

    folder = write_scene(relief_scene(64, 48, 2, held_out=0), tmp_path / "scene")
    for path in (folder / "depth_initial").iterdir():
        write_npz(path, HUGE)
    ended = subprocess.run([sys.executable, "-m", "pagas_cl", "refine", str(folder), "--depth-dir",
                            str(folder / "depth_initial"), "--save-depth", str(tmp_path / "out")],
                           capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2, ended.stderr
    assert "more than 100 times the pixels of its photo" in ended.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").rglob("*.npz"))


def test_the_array_called_depth_is_taken(tmp_path):
    np.savez(tmp_path / "a.npz", conf=np.ones((3, 4)), depth=np.full((3, 4), 2.0))
    assert stored_shape(tmp_path / "a.npz") == (3, 4) and (load_depth(tmp_path / "a.npz") == 2).all()


def test_an_exr_without_its_library_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "a.exr").write_bytes(b"v/1\x01")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtraError, match=r'reading .*a.exr.* needs OpenEXR, .*pip install "pagas-cl\[exr\]"'):
        load_depth(tmp_path / "a.exr")


def test_blenders_exr_with_colours_and_background(tmp_path):
    """Its Z stands next to R, G and B, of which R was taken for the depth; it is 1e10 where there is nothing."""
    exr, path = pytest.importorskip("OpenEXR"), tmp_path / "a.exr"
    depth = np.add.outer(np.arange(6), np.arange(8)).astype(np.float32) + 2
    stored = np.where(depth > 12, np.float32(1e10), depth)
    channels = {"R": depth / 99, "G": depth / 99, "B": depth / 99, "A": depth / 99, "Z": stored}
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels) as file:
        file.write(str(path))
    assert np.array_equal(load_depth(path), np.where(depth > 12, 0, depth))


def test_exr_of_every_compression_channel_and_kind(tmp_path):
    exr, path = pytest.importorskip("OpenEXR"), tmp_path / "a.exr"
    values = np.random.default_rng(0).random((40, 33)).astype(np.float32)
    for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ"):
        header = {"compression": getattr(exr, f"{name}_COMPRESSION"), "type": exr.scanlineimage}
        with exr.File(header, {"Y": values, "B": values + 9}) as file:
            file.write(str(path))
        assert np.array_equal(load_depth(path), values), name
    with exr.File(header, {"Z": values.astype(np.float16)}) as file:
        file.write(str(path))
    assert np.array_equal(load_depth(path), values.astype(np.float16).astype(np.float32))
    for channels in ({"normal": values}, {f"c{k}": values for k in range(40)}):
        with exr.File(header, channels) as file:
            file.write(str(path))
        with pytest.raises(InputError, match="expected one of R, Y, Z"):
            load_depth(path)
