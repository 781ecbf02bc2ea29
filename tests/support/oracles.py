"""Independent readings of every camera format, from their definitions alone: bytes -> [(K, world_to_camera)].

Pixel centres at +0.5; K is None where the bytes do not hold it. Nothing is checked here: that is the readers' part.
"""

import json
from xml.etree import ElementTree

import numpy as np
import pytest

FLIP = np.diag([1.0, -1, -1, 1])


def full(rows):
    return np.vstack([np.asarray(rows, float).reshape(-1, 4)[:3], [0, 0, 0, 1]])


def nerfstudio(data):
    d = json.loads(data.decode("utf-8-sig"))
    result = []
    for f in d["frames"]:
        v = {**d, **f}
        K = np.array([[v["fl_x"], 0, v["cx"]], [0, v["fl_y"], v["cy"]], [0, 0, 1.0]])
        result.append((K, np.linalg.inv(np.array(f["transform_matrix"], float) @ FLIP)))
    return result


def mvsnet(data):
    t = data.decode("utf-8-sig").split()
    return [(np.array(t[18:27], float).reshape(3, 3), np.array(t[1:17], float).reshape(4, 4))]


def open3d(data):
    result = []
    for p in json.loads(data.decode("utf-8-sig"))["parameters"]:
        K = np.array(p["intrinsic"]["intrinsic_matrix"], float).reshape(3, 3, order="F")
        K[:2, 2] += 0.5
        result.append((K, np.array(p["extrinsic"], float).reshape(4, 4, order="F")))
    return result


def log(data):
    rows = [line.split() for line in data.decode("utf-8-sig").splitlines() if line.strip()]
    return [(None, np.linalg.inv(np.array(rows[i + 1:i + 5], float))) for i in range(0, len(rows), 5)]


def bundler(data):
    rows = [r.split() for r in data.decode("utf-8-sig").splitlines()[1:] if r.strip() and not r.startswith("#")]
    result = []
    for i in range(int(rows[0][0])):
        f = float(rows[1 + 5 * i][0])
        if f:
            block = np.array(rows[2 + 5 * i:6 + 5 * i], float)
            result.append((np.diag([f, f, 1]), FLIP @ full(np.column_stack([block[:3], block[3]]))))
    return result


def meshlab(data):
    result = []
    for e in ElementTree.fromstring(data).iter("VCGCamera"):
        a = {k: np.array(v.split(), float) for k, v in e.attrib.items()}
        R = FLIP[:3, :3] @ a["RotationMatrix"].reshape(4, 4)[:3, :3]
        fx, fy = a["FocalMm"][0] / a["PixelSizeMm"]
        K = np.array([[fx, 0, a["CenterPx"][0]], [0, fy, a["ViewportPx"][1] - a["CenterPx"][1]], [0, 0, 1]])
        result.append((K, full(np.column_stack([R, R @ a["TranslationVector"][:3]]))))
    return result


def _colmap(rows):
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

    return [(None, full(np.column_stack([Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t])))
            for name, q, t in sorted(rows, key=lambda row: row[0])]


def colmap_txt(data):
    lines = [line.strip() for line in data.decode().splitlines()]
    heads, k = [], 0
    while k < len(lines):
        if lines[k] and not lines[k].startswith("#"):
            heads.append(lines[k].split(maxsplit=9))
            k += 1
        k += 1
    return _colmap([(h[9], np.array(h[1:5], float), np.array(h[5:8], float)) for h in heads])


def colmap_bin(data):
    import struct

    rows, place = [], 8
    for _ in range(int.from_bytes(data[:8], "little")):
        numbers = np.frombuffer(data, "<f8", 7, place + 4)
        end = data.index(b"\0", place + 64)
        rows.append((data[place + 64:end].decode(), numbers[:4], numbers[4:]))
        place = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return _colmap(rows)


def camera_file(data):
    views = json.loads(data.decode("utf-8-sig"))["views"]
    return [(np.array([[v["fx"], 0, v["cx"]], [0, v["fy"], v["cy"]], [0, 0, 1.0]]),
             np.array(v["world_to_camera"], float)) for v in views]


SIZE = np.array([64, 48])        # of the photos of test_fuzz_readers


def _arrays(data, *names):
    import io

    file = np.load(io.BytesIO(data))
    return [np.asarray(file[name], float) for name in names]


def _scaled(K, scale, offset=(0, 0)):
    K = np.array(K, float)
    K[:2, 2] -= offset
    return np.diag([1 / scale[0], 1 / scale[1], 1]) @ K


def da3(data):
    depth, intrinsics, extrinsics = _arrays(data, "depth", "intrinsics", "extrinsics")
    scale = np.array(depth.shape[2:0:-1]) / SIZE
    return [(_scaled(K, scale), full(E)) for K, E in zip(intrinsics, extrinsics)]


def vggt(data):
    depth, intrinsics, extrinsics = _arrays(data, "depth", "intrinsic", "extrinsic")
    s = depth.shape[1] / SIZE.max()
    return [(_scaled(K, (s, s), s * (SIZE.max() - SIZE) / 2), full(E)) for K, E in zip(intrinsics, extrinsics)]


def mapanything(data):
    depth, intrinsics, poses = _arrays(data, "depth_z", "intrinsics", "camera_poses")
    size = np.array(depth.shape[2:0:-1])
    scale, offset = size / SIZE, (0, 0)
    if b"img_no_norm.npy" not in data[data.index(b"PK\1\2"):]:     # nothing to compare with: cropped, as it does
        scale = np.full(2, scale.max())
        offset = (size - scale * SIZE) / 2
    return [(_scaled(intrinsics[0], scale, offset), np.linalg.inv(poses[0]))]


def _posed(quaternion, place):
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

    return full(np.column_stack([Rotation.from_quat(quaternion).as_matrix(), place]))


def record3d(data):
    d = json.loads(data.decode("utf-8-sig"))
    result = []
    for k, p in enumerate(d["poses"]):
        each = d.get("perFrameIntrinsicCoeffs")
        f = each[k] if isinstance(each, list) and len(each) == len(d["poses"]) else [d["K"][i] for i in (0, 4, 6, 7)]
        s = SIZE / (d["w"], d["h"])
        K = np.array([[f[0] * s[0], 0, f[2] * s[0]], [0, f[1] * s[1], f[3] * s[1]], [0, 0, 1]])
        result.append((K, np.linalg.inv(_posed(p[:4], p[4:]) @ FLIP)))
    return result


def polycam(data):
    d = json.loads(data.decode("utf-8-sig"))
    K = np.array([[d["fx"], 0, d["cx"]], [0, d["fy"], d["cy"]], [0, 0, 1.0]])
    return [(K, np.linalg.inv(full([[d[f"t_{r}{c}"] for c in range(4)] for r in range(3)]) @ FLIP))]


def pose_txt(data):
    return [(None, np.linalg.inv(np.array(data.decode("utf-8-sig").split(), float).reshape(4, 4)))]


def poses_txt(data):
    lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip()]
    return [pose_txt(line.encode())[0] for line in lines[:3]]


def tum(data):
    """Of the photos' three times, which are 1/30 s apart, the nearest pose within 0.03 s."""
    rows = [line.replace(",", " ").split() for line in data.decode("utf-8-sig").splitlines()]
    rows = [np.array(row[:8], float) for row in rows if row and not row[0].startswith("#")]
    rows.sort(key=lambda row: row[0])
    result = []
    for k in range(3):
        row = min(rows, key=lambda row: abs(row[0] - round(1305031102.175304 + k / 30, 6)))
        if abs(row[0] - round(1305031102.175304 + k / 30, 6)) <= 0.03:
            result.append((None, np.linalg.inv(_posed(row[4:], row[1:4]))))
    return result


def same(cameras, expected):
    assert len(cameras) == len(expected)
    for camera, (K, pose) in zip(cameras, expected):
        P, Q = camera.world_to_camera, pose
        assert np.abs(P[:3, :3] - Q[:3, :3]).max() < 3e-3  # inverse of a slightly damaged rotation
        assert np.abs(P[:3, 3] - Q[:3, 3]).max() <= 3e-3 * max(1, np.abs(Q[:3, 3]).max())
        if K is not None:
            got = camera.K if K[0, 2] or K[1, 2] else np.diag([camera.fx, camera.fy, 1])
            assert np.abs(got - K).max() <= 1e-9 * max(1, np.abs(K).max())
