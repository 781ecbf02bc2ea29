"""Damaged files: each gives an InputError or a right result; never a crash, a hang, much memory, or a wrong camera.

A result is right when it is what an independent reading of the same bytes, written here from the format's definition
alone, gives. PAGAS_FUZZ=2000 pytest tests/test_fuzz_readers.py runs 2000 inputs for each reader; the default is few.
"""

import io
import json
import os
import signal
import zipfile
from contextlib import contextmanager
from xml.etree import ElementTree

import mutations
import numpy as np
import pytest
import rigs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import (bundler, camera_file, meshlab, mvsnet, nerfstudio, neus, open3d_trajectory,
                                    read_scene)

COUNT = int(os.environ.get("PAGAS_FUZZ", "80"))
FLIP = np.diag([1.0, -1, -1, 1])


@contextmanager
def bounded(seconds=5.0, more_bytes=3 << 30):
    """A hang becomes an exception, and so does asking for gigabytes."""
    import resource

    def late(*_):
        raise TimeoutError(f"took more than {seconds} s")

    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (used + more_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)


def full(rows):
    return np.vstack([np.asarray(rows, float).reshape(-1, 4)[:3], [0, 0, 0, 1]])


# -- independent readings: bytes -> [(K, world_to_camera)], pixel centres at +0.5 ------------------------------------

def oracle_nerfstudio(data):
    d = json.loads(data.decode("utf-8-sig"))
    result = []
    for f in d["frames"]:
        v = {**d, **f}
        K = np.array([[v["fl_x"], 0, v["cx"]], [0, v["fl_y"], v["cy"]], [0, 0, 1.0]])
        result.append((K, np.linalg.inv(np.array(f["transform_matrix"], float) @ FLIP)))
    return result


def oracle_mvsnet(data):
    t = data.decode("utf-8-sig").split()
    return [(np.array(t[18:27], float).reshape(3, 3), np.array(t[1:17], float).reshape(4, 4))]


def oracle_open3d(data):
    result = []
    for p in json.loads(data.decode("utf-8-sig"))["parameters"]:
        K = np.array(p["intrinsic"]["intrinsic_matrix"], float).reshape(3, 3, order="F")
        K[:2, 2] += 0.5
        result.append((K, np.array(p["extrinsic"], float).reshape(4, 4, order="F")))
    return result


def oracle_log(data):
    rows = [line.split() for line in data.decode("utf-8-sig").splitlines() if line.strip()]
    return [(None, np.linalg.inv(np.array(rows[i + 1:i + 5], float))) for i in range(0, len(rows), 5)]


def oracle_bundler(data):
    rows = [r.split() for r in data.decode("utf-8-sig").splitlines()[1:] if r.strip() and not r.startswith("#")]
    result = []
    for i in range(int(rows[0][0])):
        f = float(rows[1 + 5 * i][0])
        if f:
            block = np.array(rows[2 + 5 * i:6 + 5 * i], float)
            result.append((np.diag([f, f, 1]), FLIP @ full(np.column_stack([block[:3], block[3]]))))
    return result


def oracle_meshlab(data):
    result = []
    for e in ElementTree.fromstring(data).iter("VCGCamera"):
        a = {k: np.array(v.split(), float) for k, v in e.attrib.items()}
        R = FLIP[:3, :3] @ a["RotationMatrix"].reshape(4, 4)[:3, :3]
        fx, fy = a["FocalMm"][0] / a["PixelSizeMm"]
        K = np.array([[fx, 0, a["CenterPx"][0]], [0, fy, a["ViewportPx"][1] - a["CenterPx"][1]], [0, 0, 1]])
        result.append((K, full(np.column_stack([R, R @ a["TranslationVector"][:3]]))))
    return result


def _colmap(rows):
    from scipy.spatial.transform import Rotation

    return [(None, full(np.column_stack([Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t])))
            for name, q, t in sorted(rows, key=lambda row: row[0])]


def oracle_colmap_txt(data):
    lines = [line.strip() for line in data.decode().splitlines()]
    heads, k = [], 0
    while k < len(lines):
        if lines[k] and not lines[k].startswith("#"):
            heads.append(lines[k].split(maxsplit=9))
            k += 1
        k += 1
    return _colmap([(h[9], np.array(h[1:5], float), np.array(h[5:8], float)) for h in heads])


def oracle_colmap_bin(data):
    import struct

    rows, place = [], 8
    for _ in range(int.from_bytes(data[:8], "little")):
        numbers = np.frombuffer(data, "<f8", 7, place + 4)
        end = data.index(b"\0", place + 64)
        rows.append((data[place + 64:end].decode(), numbers[:4], numbers[4:]))
        place = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return _colmap(rows)


def oracle_camera_file(data):
    views = json.loads(data.decode("utf-8-sig"))["views"]
    return [(np.array([[v["fx"], 0, v["cx"]], [0, v["fy"], v["cy"]], [0, 0, 1.0]]),
             np.array(v["world_to_camera"], float)) for v in views]


def same(cameras, expected):
    assert len(cameras) == len(expected)
    for camera, (K, pose) in zip(cameras, expected):
        P, Q = camera.world_to_camera, pose
        assert np.abs(P[:3, :3] - Q[:3, :3]).max() < 3e-3  # inverse of a slightly damaged rotation
        assert np.abs(P[:3, 3] - Q[:3, 3]).max() <= 3e-3 * max(1, np.abs(Q[:3, 3]).max())
        if K is not None:
            got = camera.K if K[0, 2] or K[1, 2] else np.diag([camera.fx, camera.fy, 1])
            assert np.abs(got - K).max() <= 1e-9 * max(1, np.abs(K).max())


# -- the files: written by their own library where there is one, else by ours ----------------------------------------

def make_open3d(folder, views):
    """By Open3D itself."""
    o3d = pytest.importorskip("open3d")
    trajectory = o3d.camera.PinholeCameraTrajectory()
    parameters = []
    for view in views:
        p = o3d.camera.PinholeCameraParameters()
        c = view.camera
        p.intrinsic = o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx - 0.5, c.cy - 0.5)
        p.extrinsic = c.world_to_camera
        parameters.append(p)
    trajectory.parameters = parameters
    o3d.io.write_pinhole_camera_trajectory(str(folder / "trajectory.json"), trajectory)


def make_log(folder, views):
    open3d_trajectory.write_log(folder / "trajectory.log", [v.camera for v in views])


def make_meshlab(folder, views):
    """By pymeshlab itself, from ours."""
    pymeshlab = pytest.importorskip("pymeshlab")
    meshlab.write_project(folder / "ours.mlp", views)
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(folder / "ours.mlp"))
    meshes.save_project(str(folder / "project.mlp"))
    (folder / "ours.mlp").unlink()


def make_colmap(folder, views, binary=True):
    """By pycolmap itself."""
    pytest.importorskip("pycolmap")
    from test_readers_colmap import write_model

    write_model(folder, [v.camera for v in views], binary=binary, photos=False)


READERS = {
    "cameras": (camera_file.write, "cameras.json", oracle_camera_file, {}),
    "colmap": (make_colmap, "sparse/0/images.bin", oracle_colmap_bin, {}),
    "colmap_txt": (lambda folder, views: make_colmap(folder, views, False), "sparse/0/images.txt", oracle_colmap_txt,
                   {}),
    "nerfstudio": (nerfstudio.write, "transforms.json", oracle_nerfstudio, {}),
    "mvsnet": (mvsnet.write, "cams/00000000_cam.txt", oracle_mvsnet, {}),
    "open3d": (make_open3d, "trajectory.json", oracle_open3d, {}),
    "open3d_log": (make_log, "trajectory.log", oracle_log, {}),
    "bundler": (bundler.write, "bundle.out", oracle_bundler, {}),
    "meshlab": (make_meshlab, "project.mlp", oracle_meshlab, {"flavour": "meshlab"}),
}


@pytest.fixture(scope="module", params=READERS)
def target(request, tmp_path_factory):
    """(format, folder, file that is damaged, independent reading, options)"""
    make, name, oracle, options = READERS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    views = rigs.with_photos(folder, rigs.random_cameras(
        1 if request.param == "mvsnet" else 3, centred=request.param == "bundler", square=request.param == "bundler",
        same=request.param in ("open3d_log", "colmap", "colmap_txt")))
    make(folder, views)
    return request.param.split("_")[0], folder, folder / name, oracle, options


def judge(format, folder, oracle, options, data: bytes) -> bool:
    """Whether the damaged file was read (rightly); False where it was refused."""
    try:
        with bounded():
            scene = read_scene(folder, format, **options)
    except InputError as error:
        assert 10 < len(str(error)) < 1200 and "\n" not in str(error).strip()
        return False
    try:
        expected = oracle(data)
    except Exception as error:
        raise AssertionError(f"read what an independent reading refuses: {error!r}") from error
    same(scene.cameras, expected)
    for camera in scene.cameras:
        camera.rays() if camera.width * camera.height < 1e6 else None
    return True


def test_damaged_bytes(target):
    format, folder, path, oracle, options = target
    original = path.read_bytes()
    assert judge(format, folder, oracle, options, original)
    rng = np.random.default_rng(7)
    outcomes = []
    try:
        for _ in range(COUNT):
            data = mutations.mutate(original, rng)
            path.write_bytes(data)
            try:
                outcomes.append(judge(format, folder, oracle, options, data))
            except BaseException:
                (folder / "failed").write_bytes(data)
                raise
    finally:
        path.write_bytes(original)
    assert len(outcomes) == COUNT and not all(outcomes)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from(["images/x.png", 1e300]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4), max_leaves=12)


def places(value, path=()):
    """Paths of all values in nested JSON."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, path + (key,))


@pytest.mark.parametrize("name", ["nerfstudio", "open3d", "cameras"])
def test_any_json_value_anywhere(name, tmp_path):
    make, file, oracle, options = READERS[name]
    make(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(2)))
    path = tmp_path / file
    original = json.loads(path.read_text())
    paths = list(places(original))

    @settings(max_examples=COUNT, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(st.sampled_from(paths), json_values)
    def run(place, value):
        changed = json.loads(json.dumps(original))
        if not place:
            changed = value
        else:
            holder = changed
            for key in place[:-1]:
                holder = holder[key]
            holder[place[-1]] = value
        data = json.dumps(changed).encode()
        path.write_bytes(data)
        judge(name, tmp_path, oracle, options, data)

    run()


def test_a_misspelt_key_never_changes_a_camera(tmp_path):
    """Optional keys have defaults, which must not replace a value whose key was damaged by one letter."""
    nerfstudio.write(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(2)))
    path = tmp_path / "transforms.json"
    before = read_scene(tmp_path).cameras
    text = path.read_text()
    refused = 0
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "frames", "file_path", "transform_matrix", "camera_model"):
        for place in range(len(key)):
            for letter in "qX_0":
                path.write_text(text.replace(f'"{key}"', f'"{key[:place] + letter + key[place + 1:]}"', 1))
                try:
                    after = read_scene(tmp_path, "nerfstudio").cameras
                    assert max(map(rigs.worst_difference, before, after)) == 0
                except InputError:
                    refused += 1
    assert refused > 100


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
    neus.write(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(3)))
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
    """Files that claim to be huge are refused before memory is asked for."""
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
    nerfstudio.write(tmp_path, views)
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
    else:
        path.write_bytes(b"%d&%d&1&" % depth.shape[::-1] + depth.tobytes())


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.pfm", "a.png", "a.jpg.geometric.bin"])
def test_damaged_depth_maps(tmp_path, name):
    """A depth map is refused, or clean: float32, finite, nowhere below 0, of the size asked for."""
    from pagas_cl.scene.depthmap import load_depth

    rng = np.random.default_rng(2)
    path, scale = tmp_path / name, 50.0 if name.endswith(".png") else None
    write_depth(path, rng.uniform(1, 9, (12, 16)).astype(np.float32))
    original, read = path.read_bytes(), 0
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
    assert 0 < read < COUNT


@pytest.mark.parametrize("binary", [True, False])
def test_all_files_of_a_colmap_model_damaged(tmp_path, binary):
    """Cameras and points too: refused, or read as the undamaged images with other intrinsics."""
    views = rigs.with_photos(tmp_path, rigs.random_cameras(3, same=True))
    make_colmap(tmp_path, views, binary)
    place = tmp_path / "sparse/0"
    before, rng, read = read_scene(tmp_path, "colmap"), np.random.default_rng(5), 0
    for part in ("cameras", "points3D"):
        path = place / (part + (".bin" if binary else ".txt"))
        original = path.read_bytes()
        for _ in range(COUNT // 2):
            path.write_bytes(mutations.mutate(original, rng))
            try:
                with bounded():
                    scene = read_scene(tmp_path, "colmap")
            except InputError:
                continue
            read += 1
            for a, b in zip(before.cameras, scene.cameras, strict=True):
                assert np.array_equal(a.world_to_camera, b.world_to_camera) and (b.width, b.height) == (64, 48)
        path.write_bytes(original)
    assert read
