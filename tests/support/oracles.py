"""Independent readings of every camera format, from their definitions alone: bytes -> [(K, world_to_camera)].

Pixel centres at +0.5; K is None where the bytes do not hold it. Nothing is checked here: that is the readers' part.
"""

import json
from xml.etree import ElementTree

import numpy as np

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
    from scipy.spatial.transform import Rotation

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


def same(cameras, expected):
    assert len(cameras) == len(expected)
    for camera, (K, pose) in zip(cameras, expected):
        P, Q = camera.world_to_camera, pose
        assert np.abs(P[:3, :3] - Q[:3, :3]).max() < 3e-3  # inverse of a slightly damaged rotation
        assert np.abs(P[:3, 3] - Q[:3, 3]).max() <= 3e-3 * max(1, np.abs(Q[:3, 3]).max())
        if K is not None:
            got = camera.K if K[0, 2] or K[1, 2] else np.diag([camera.fx, camera.fy, 1])
            assert np.abs(got - K).max() <= 1e-9 * max(1, np.abs(K).max())
