"""TUM RGB-D, and KinectFusion lists of its form: `rgb.txt`, `depth.txt`, `groundtruth.txt`, or `associations.txt`.

Convention: `timestamp tx ty tz qx qy qz qw`, camera-to-world, metres, OpenCV; depth registered to colour, 5000 a metre;
pixel centres at whole numbers. Intrinsics are not in the folder: `camera-intrinsics.txt`, `K.txt` (3 x 3) or
`camera_intrinsic.json`, else the 525 pixels, (319.5, 239.5), that the data set's page gives.
"""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import intrinsics
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene

LISTS = ("associations.txt", "associate.txt", "associated.txt")
EXPECTED = f"groundtruth.txt with rgb.txt or {LISTS[0]}"
_INTRINSICS = ("camera-intrinsics.txt", "K.txt", "intrinsics.txt")
_DEFAULT = intrinsics(525.0, 525.0, 319.5, 239.5)
_APART = 0.03        # seconds between a photo and its depth map or pose
_ROWS = 1_000_000


def detect(folder: Path) -> Path | None:
    """The trajectory, where a list of photos is there too."""
    if photos.first_file(folder, (*LISTS, "rgb.txt")) is None:
        return None
    return photos.first_file(folder, ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt",
                                      "KeyFrameTrajectory.txt")) or min(folder.glob("*.freiburg"), default=None)


def read(folder: Path, trajectory: Path, *, outside: bool = False) -> Scene:
    """Read the photos that have a pose within 0.03 s, and depth maps likewise; `outside`: also files outside
    `folder`."""
    poses = _rows(trajectory, 8)
    numbers = untrusted.floats([text for row in poses for text in row[:8]], str(trajectory)).reshape(-1, 8)
    times = numbers[:, 0]
    order = np.argsort(times, kind="stable")
    frames, lost = [], 0
    for time, photo, depth in _pairs(folder):
        k = order[_nearest(times[order], time)]
        if abs(times[k] - time) > _APART:
            lost += 1
            continue
        pose = untrusted.pose(numbers[k, 4:8], numbers[k, 1:4], f"{trajectory}, time {poses[k][0]}")
        image = photos.named(folder, photo, f"{folder}: photo", outside)
        file = depth and photos.named(folder, depth, f"{folder}: depth", outside)
        K = rgbd.K_or_default(folder, _INTRINSICS, image, _DEFAULT)
        frames.append(rgbd.Frame(image, pose, K, file or None, pixel_center=0.0))
    source = f"{trajectory} (TUM)"
    if not frames:
        raise InputError(f"{source}: none of the {lost} photos has a pose within {_APART} s")
    if lost:
        log.info("%s: %d photos have no pose within %g s and are left out", source, lost, _APART)
    return rgbd.scene_of(folder, frames, rgbd.Depth(5000.0, "5000 for a metre, as the format says"), source)


def _rows(path: Path, least: int) -> list[list[str]]:
    rows = [line.replace(",", " ").split() for line in untrusted.read_text(path).splitlines()
            if line.strip() and not line.lstrip().startswith("#")]
    if not rows or len(rows) > _ROWS:
        raise InputError(f"{path} has {len(rows)} lines, expected 1 to {_ROWS}")
    for row in rows:
        if len(row) < least:
            raise InputError(f"{path}: line {short(' '.join(row))} has {len(row)} fields, expected {least}")
    return rows


def _pairs(folder: Path) -> list[tuple[float, str, str]]:
    """Time and name of each photo, and its depth map's name, or ''."""
    both = photos.first_file(folder, LISTS)
    if both is not None:
        found = []
        for row in _rows(both, 4):
            is_photo = "rgb" in row[1] or "color" in row[1] or row[1].lower().endswith((".jpg", ".jpeg"))
            color, depth = (0, 2) if is_photo else (2, 0)
            found.append((untrusted.float_of(row[color], f"{both}: time"), row[color + 1], row[depth + 1]))
        return found
    names = _rows(folder / "rgb.txt", 2)
    depths = _rows(folder / "depth.txt", 2) if (folder / "depth.txt").is_file() else []
    times = np.array([untrusted.float_of(row[0], "depth.txt: time") for row in depths])
    found = []
    for row in names:
        time = untrusted.float_of(row[0], "rgb.txt: time")
        k = int(np.argmin(np.abs(times - time))) if len(times) else -1
        found.append((time, row[1], depths[k][1] if k >= 0 and abs(times[k] - time) <= _APART else ""))
    return found


def _nearest(times: np.ndarray, time: float) -> int:
    """Place of the nearest of the sorted `times`."""
    k = int(np.searchsorted(times, time))
    return min((j for j in (k - 1, k) if 0 <= j < len(times)), key=lambda j: abs(times[j] - time))
