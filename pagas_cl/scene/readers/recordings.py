"""RGB-D recordings: what all share, and the data sets ScanNet, 7-Scenes, TUM, and multi-view stereo networks'.

These have poses camera-to-world, OpenCV, metres, and depth as 16-bit PNG. What differs stands at each reader.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import intrinsics
from pagas_cl.scene.depth.placement import Placement
from pagas_cl.scene.depth.source import DepthSource, Stored, with_least_confidence
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene

_MILLIMETRES = (1000.0, "millimetres, as the format says")
_VGA = (640, 480)
_COLOR_K, _DEPTH_K = "intrinsic/intrinsic_color.txt", "intrinsic/intrinsic_depth.txt"
_KINECT = intrinsics(585.0, 585.0, 320.0, 240.0)
_KINECT_K = ("camera-intrinsics.txt", "intrinsics.txt", "K.txt", "../camera-intrinsics.txt")
_PLACES = (".", "data", "seq-01")
_TUM = intrinsics(525.0, 525.0, 319.5, 239.5)
_TUM_K = ("camera-intrinsics.txt", "K.txt", "intrinsics.txt")
_LISTS = ("associations.txt", "associate.txt", "associated.txt")
_APART = 0.03        # seconds between a photo and its depth map or pose
_ROWS = 1_000_000


@dataclass(frozen=True)
class Frame:
    """One frame: the photo, its pose (camera-to-world, OpenCV axes), its K, and its depth map if it has one."""

    photo: Path
    camera_to_world: np.ndarray
    K: np.ndarray
    depth: Path | Stored | None = None
    confidence: Path | Stored | None = None
    placement: Placement | None = None
    pixel_center: float = 0.5


def scene_of(folder: Path, frames: Sequence[Frame], source: str, scale: float, unit: str,
             invalid: float | None = None) -> Scene:
    """The scene without frames whose pose is not finite; `scale`, `invalid` as of a DepthSource, `unit` in words."""
    tracked = [frame for frame in frames if np.isfinite(frame.camera_to_world).all()]
    if not tracked:
        raise InputError(f"{source}: none of the {len(frames)} frames has a pose")
    if len(tracked) < len(frames):
        log.info("%s: %d of %d frames have no pose (tracking failed) and are left out", source,
                 len(frames) - len(tracked), len(frames))
    views, depths = [], list[DepthSource | None]()
    for frame in tracked:
        width, height = photos.photo_size(frame.photo)
        camera = untrusted.pinhole(frame.K, frame.camera_to_world, width, height, frame.photo.name,
                                   pixel_center=frame.pixel_center, camera_to_world=True)
        views.append(photos.view_of(folder, camera, frame.photo))
        depths.append(None if frame.depth is None else DepthSource(
            frame.depth, (width, height), scale, frame.placement, frame.confidence, invalid=invalid))
    depths = with_least_confidence(depths, source)
    return Scene(views, source, depths=tuple(depths) if any(depths) else None, depth_unit=unit)


def by_number(found: list[Path]) -> list[Path]:
    """Photos whose names are numbers, in the order of these: 2.jpg before 10.jpg."""
    return sorted(found, key=lambda path: (len(path.stem), path.stem))


def _all_of(*names: str) -> Callable[[Path], Path | None]:
    """Detects where all of these are in a folder; gives the first."""
    return lambda folder: folder / names[0] if all((folder / name).exists() for name in names) else None


def _read_scannet(folder: Path, color_K: Path) -> Scene:
    """ScanNet as its SensReader exports it: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_*.txt`.

    Poses are -inf where tracking was lost; depth has intrinsics of its own; pixel centres are taken to be at +0.5.
    """
    K = _matrix_of(color_K, 3, 4)[:3, :3]
    placement, frames = None, []
    if (folder / _DEPTH_K).is_file():       # of a camera at the same place
        depth_K = _matrix_of(folder / _DEPTH_K, 3, 4)[:3, :3]
        scale = depth_K[0, 0] / K[0, 0], depth_K[1, 1] / K[1, 1]
        if not (np.isfinite(scale).all() and min(scale) > 0):
            raise InputError("the focal lengths of photo and depth map are not above 0")
        placement = Placement(scale, (depth_K[0, 2] - scale[0] * K[0, 2], depth_K[1, 2] - scale[1] * K[1, 2]),
                              "by intrinsics")
    for photo in by_number(photos.list_photos(folder / "color")):
        pose = folder / "pose" / f"{photo.stem}.txt"
        if not pose.is_file():
            raise InputError(f"{photo}: its pose {pose} is missing")
        depth = photos.first_file(folder / "depth", (f"{photo.stem}.png",))
        frames.append(Frame(photo, _pose_of(pose), K, depth, placement=placement))
    if not frames:
        raise InputError(f"{folder / 'color'} has no photos")
    return scene_of(folder, frames, f"{folder} (ScanNet)", *_MILLIMETRES)


def _pose_of(path: Path) -> np.ndarray:
    """A 4 x 4 matrix of a text file, float64; NaN where it holds inf or nan, as of frames without tracking."""
    tokens = _numbers_of(path, 4)
    if any(token.lower().lstrip("+-") in ("inf", "nan", "infinity") for token in tokens):
        return np.full((4, 4), np.nan)
    return untrusted.floats(tokens, str(path)).reshape(4, 4)


def _matrix_of(path: Path, *sides: int) -> np.ndarray:
    """A square matrix of a text file (K may be one of 4 x 4), float64."""
    tokens = _numbers_of(path, *sides)
    side = math.isqrt(len(tokens))
    return untrusted.floats(tokens, str(path)).reshape(side, side)


def _numbers_of(path: Path, *sides: int) -> list[str]:
    """The words of a text file: as many as a square matrix of one of the `sides` has."""
    tokens = untrusted.read_text(path, 1 << 16).split()
    if len(tokens) not in [side**2 for side in sides]:
        raise InputError(f"{path} holds {len(tokens)} numbers, expected {' or '.join(f'{n} x {n}' for n in sides)}")
    return tokens


def _detect_kinect(folder: Path) -> Path | None:
    """Where there are frame-*.pose.txt: the folder, data/ or seq-01/; or None."""
    return next((folder / name for name in _PLACES if (folder / name).is_dir()
                 and next((folder / name).glob("frame-*.pose.txt"), None) is not None), None)


def _read_kinect(folder: Path, place: Path) -> Scene:
    """7-Scenes, and KinectFusion recordings of its form: `frame-NNNNNN.color.png`, `.depth.png`, `.pose.txt`.

    Depth is 65535 where there is none, and in 7-Scenes not registered to colour. Intrinsics are
    `camera-intrinsics.txt` (3 x 3), else those that the data set's page states: 585 pixels, principal point (320, 240).
    """
    others = sorted(path.name for path in folder.glob("seq-*") if path.is_dir() and path != place)
    if others:
        log.warning("%s is read; %s are other sequences and are not: name one as the scene to read it", place,
                    ", ".join(others[:5]))
    source = f"{place} (7-Scenes, KinectFusion)"
    frames = []
    for pose in sorted(place.glob("frame-*.pose.txt")):
        stem = pose.name.removesuffix(".pose.txt")
        photo = photos.first_file(place, (f"{stem}.color.png", f"{stem}.color.jpg"))
        if photo is None:
            raise InputError(f"{pose}: its photo {stem}.color.png is missing")
        frames.append(Frame(photo, _pose_of(pose), _K_or_default(place, _KINECT_K, photo, _KINECT),
                            photos.first_file(place, (f"{stem}.depth.png",))))
    if photos.first_file(place, _KINECT_K) is None:
        log.warning("%s: no camera-intrinsics.txt; the data set's 585 pixels are taken, and its depth is not "
                    "registered to the photos: expect them to be off by some pixels", source)
    return scene_of(folder, frames, source, *_MILLIMETRES, invalid=65535)


def _K_or_default(folder: Path, names: Sequence[str], photo: Path, default: np.ndarray) -> np.ndarray:
    """K of the first of the files `names`; else the `default` of a data set whose photos are 640 x 480."""
    path = photos.first_file(folder, names)
    if path is not None:
        return _matrix_of(path, 3, 4)[:3, :3]
    size = photos.photo_size(photo)
    if size != _VGA:
        raise InputError(f"{folder} has no {names[0]} and photos of {size[0]} x {size[1]}, expected {_VGA[0]} x "
                         f"{_VGA[1]} for the data set's own intrinsics; put the file (3 x 3) there")
    return default


def _detect_tum(folder: Path) -> Path | None:
    if photos.first_file(folder, (*_LISTS, "rgb.txt")) is None:
        return None
    return photos.first_file(folder, ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt",
                                      "KeyFrameTrajectory.txt")) or min(folder.glob("[!.]*.freiburg"), default=None)


def _read_tum(folder: Path, trajectory: Path, *, outside: bool = False) -> Scene:
    """TUM RGB-D, and KinectFusion lists of its form: `rgb.txt`, `depth.txt`, `groundtruth.txt`, or `associations.txt`.

    Poses are `timestamp tx ty tz qx qy qz qw`; depth is registered to colour, 5000 a metre; pixel centres are at whole
    numbers. Intrinsics are those of one of the files _TUM_K (3 x 3), else the data set's 525 pixels, (319.5, 239.5).
    Read are photos that have a pose within 0.03 s, and depth maps likewise; `outside`: also files outside `folder`.
    """
    poses = _rows(trajectory, 8)
    numbers = untrusted.floats([text for row in poses for text in row[:8]], str(trajectory)).reshape(-1, 8)
    frames, lost = [], 0
    for time, photo, depth in _pairs(folder):
        k = int(np.argmin(np.abs(numbers[:, 0] - time)))
        if abs(numbers[k, 0] - time) > _APART:
            lost += 1
            continue
        pose = untrusted.pose(numbers[k, 4:8], numbers[k, 1:4], f"{trajectory}, time {poses[k][0]}")
        image = photos.named(folder, photo, f"{folder}: photo", outside)
        file = photos.named(folder, depth, f"{folder}: depth", outside) if depth else None
        frames.append(Frame(image, pose, _K_or_default(folder, _TUM_K, image, _TUM), file, pixel_center=0.0))
    source = f"{trajectory} (TUM)"
    if not frames:
        raise InputError(f"{source}: none of the {lost} photos has a pose within {_APART} s")
    if lost:
        log.info("%s: %d photos have no pose within %g s and are left out", source, lost, _APART)
    return scene_of(folder, frames, source, 5000.0, "5000 for a metre, as the format says")


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
    both, found = photos.first_file(folder, _LISTS), []
    if both is not None:
        for row in _rows(both, 4):
            is_photo = "rgb" in row[1] or "color" in row[1] or row[1].lower().endswith((".jpg", ".jpeg"))
            color, depth = (0, 2) if is_photo else (2, 0)
            found.append((untrusted.float_of(row[color], f"{both}: time"), row[color + 1], row[depth + 1]))
        return found
    names = _rows(folder / "rgb.txt", 2)
    depths = _rows(folder / "depth.txt", 2) if (folder / "depth.txt").is_file() else []
    times = np.array([untrusted.float_of(row[0], "depth.txt: time") for row in depths])
    for row in names:
        time = untrusted.float_of(row[0], "rgb.txt: time")
        k = int(np.argmin(np.abs(times - time))) if len(times) else -1
        found.append((time, row[1], depths[k][1] if k >= 0 and abs(times[k] - time) <= _APART else ""))
    return found


def _read_video(folder: Path, path: Path) -> Scene:
    """DeepVideoMVS and its followers: `K.txt`, `poses.txt`, `images/`, `depth/`.

    A line of poses.txt is a 4 x 4 matrix; line k belongs to the k-th photo by name, poses beyond the photos are left
    out and counted; K counts pixel centres at whole numbers; depth/<name>.png is registered.
    """
    images = photos.list_photos(folder / "images")
    lines = [line.split() for line in untrusted.read_text(path).splitlines() if line.strip()]
    if not images or len(lines) < len(images):
        raise InputError(f"{path} has {len(lines)} poses and {folder / 'images'} has {len(images)} photos, expected a "
                         "pose a photo")
    if len(lines) > len(images):
        log.info("%s: %d poses after the last of the %d photos are left out", path, len(lines) - len(images),
                 len(images))
    K = _matrix_of(folder / "K.txt", 3, 4)[:3, :3]
    frames = [Frame(photo, untrusted.floats(row, f"{path}, line {k + 1}", 16).reshape(4, 4), K,
                    photos.first_file(folder / "depth", (f"{photo.stem}.png",)), pixel_center=0.0)
              for k, (photo, row) in enumerate(zip(images, lines))]
    return scene_of(folder, frames, f"{path} (DeepVideoMVS)", *_MILLIMETRES)


SCANNET = photos.Format("export of ScanNet's SensReader: looked for color/, pose/ and intrinsic/intrinsic_color.txt",
                        _all_of(_COLOR_K, "pose", "color"), _read_scannet)
SEVEN_SCENES = photos.Format(f"frame-NNNNNN.pose.txt (looked in {', '.join(_PLACES)})", _detect_kinect, _read_kinect)
TUM = photos.Format(f"groundtruth.txt with rgb.txt or {_LISTS[0]}", _detect_tum, _read_tum)
VIDEO_MVS = photos.Format("poses.txt with K.txt and images/", _all_of("poses.txt", "K.txt", "images"), _read_video)
