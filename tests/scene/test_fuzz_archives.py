"""Damaged .npz cameras and depth maps, and files that claim to be huge; see test_fuzz_readers."""

import io
import zipfile

import numpy as np
import pytest
from support import mutations, rigs, scene_writers
from support.exports_rgbd import write_exr
from support.fuzzing import COUNT, bounded

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import read_scene


def oracle_neus(data):
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        keys = sorted(int(k[10:]) for k in archive if k.startswith("world_mat_") and k[10:].isdecimal())
        return [archive[f"world_mat_{k}"] for k in keys]


def judge_neus(folder, data) -> bool:
    try:
        with bounded():
            scene = read_scene(folder, "neus")
    except InputError as error:
        assert 10 < len(str(error)) < 1200
        return False
    for camera, P in zip(scene.cameras, oracle_neus(data), strict=True):
        Q = (camera.K @ camera.world_to_camera[:3]).ravel()
        P = P[:3].ravel() / np.linalg.norm(P[2, :3]) * np.sign(np.linalg.det(P[:3, :3]))
        assert np.abs(P - Q).max() < 1e-4 * np.abs(P).max()  # a skew below 0.05 pixel is dropped
    return True


def test_damaged_npz(tmp_path):
    """Bytes of the archive, and whole archives around damaged arrays."""
    scene_writers.neus(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(3)))
    path = tmp_path / "cameras.npz"
    original = path.read_bytes()
    assert judge_neus(tmp_path, original)
    rng = np.random.default_rng(3)
    outcomes = []
    for trial in range(COUNT):
        data = mutations.mutate(original, rng)
        if trial % 2:
            buffer = io.BytesIO()
            with zipfile.ZipFile(io.BytesIO(original)) as old, zipfile.ZipFile(buffer, "w") as new:
                victim = int(rng.integers(len(old.namelist())))
                for i, name in enumerate(old.namelist()):
                    content = old.read(name)
                    new.writestr(name, mutations.mutate(content, rng) if i == victim else content)
            data = buffer.getvalue()
        path.write_bytes(data)
        outcomes.append(judge_neus(tmp_path, data))
    assert any(outcomes) and not all(outcomes)


def test_real_dtu_matrices_damaged(tmp_path, data_dir):
    """The real cameras_sphere.npz of DTU scan 24."""
    rigs.with_photos(tmp_path, rigs.random_cameras(49, size=(8, 6)))
    original = (data_dir / "dtu_scan24" / "cameras_sphere.npz").read_bytes()
    path = tmp_path / "cameras_sphere.npz"
    path.write_bytes(original)
    assert judge_neus(tmp_path, original)
    rng = np.random.default_rng(11)
    for _ in range(COUNT // 4):
        data = mutations.mutate(original, rng)
        path.write_bytes(data)
        judge_neus(tmp_path, data)


def test_hostile_sizes(tmp_path):
    """Files that claim to be huge are refused before memory is allocated."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(1))
    header = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (4000000, 4000000), }"
    with zipfile.ZipFile(tmp_path / "cameras.npz", "w") as archive:
        archive.writestr("world_mat_0.npy", header.ljust(127) + b"\n" + bytes(128))
    with zipfile.ZipFile(tmp_path / "cameras_large.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", bytes(50 << 20))  # a small file that unpacks to 50 MB
    for other in ("cameras.npz", "cameras_large.npz"):
        with bounded(), pytest.raises(InputError, match="expected"):
            read_scene(tmp_path, "neus")
        (tmp_path / other).unlink()
    (tmp_path / "bundle.out").write_text("# Bundle file v0.3\n99999999 99999999\n")
    with bounded(), pytest.raises(InputError, match="cut off"):
        read_scene(tmp_path, "bundler")
    (tmp_path / "transforms.json").write_text("[" * 100000)
    with bounded(), pytest.raises(InputError, match="not valid JSON"):
        read_scene(tmp_path, "nerfstudio")
    (tmp_path / "p.mlp").write_text("<a>" * 100000)
    with bounded(), pytest.raises(InputError, match="deep"):
        read_scene(tmp_path, "meshlab")
    scene_writers.nerfstudio(tmp_path, views)
    text = (tmp_path / "transforms.json").read_text()
    huge = text.replace('"w": 64', '"w": 1000000').replace('"h": 48', '"h": 1000000')
    (tmp_path / "transforms.json").write_text(huge)
    with bounded(), pytest.raises(InputError, match="its camera says 1000000 x 1000000"):
        read_scene(tmp_path, "nerfstudio")


def write_depth(path, depth):
    """The kinds of depth maps, as their own programs write them."""
    from PIL import Image

    name = path.name
    if name.endswith(".npz"):
        np.savez_compressed(path, depth=depth)
    elif name.endswith(".npy"):
        np.save(path, depth)
    elif name.endswith(".pfm"):
        path.write_bytes(b"Pf\n%d %d\n-1.0\n" % depth.shape[::-1] + np.ascontiguousarray(depth[::-1]).tobytes())
    elif name.endswith(".png"):
        Image.fromarray((depth * 50).astype(np.uint16)).save(path)
    elif name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
        write_exr(path, depth)
    else:
        path.write_bytes(b"%d&%d&1&" % depth.shape[::-1] + depth.tobytes())


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.pfm", "a.png", "a.exr", "a.jpg.geometric.bin"])
def test_damaged_depth_maps(tmp_path, name):
    """A depth map is refused, or clean: float32, finite, nowhere below 0, of the size requested."""
    from pagas_cl.scene.depthmap import load_depth

    rng = np.random.default_rng(2)
    path, scale = tmp_path / name, 50.0 if name.endswith(".png") else None
    write_depth(path, rng.uniform(1, 9, (12, 16)).astype(np.float32))
    original, read = path.read_bytes(), 0
    assert load_depth(path, scale=scale).shape == (12, 16)
    for _ in range(COUNT):
        path.write_bytes(mutations.mutate(original, rng))
        try:
            with bounded():
                depth = load_depth(path, (24, 18), scale=scale)
        except InputError as error:
            assert 10 < len(str(error)) < 1200
            continue
        read += 1
        assert depth.shape == (18, 24) and depth.dtype == np.float32 and np.isfinite(depth).all() and depth.min() >= 0
    assert read < COUNT
