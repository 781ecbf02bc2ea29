"""What readers of RGB-D recordings share: poses out of text, frames without a pose, views with their depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.depth.placement import Placement
from pagas_cl.scene.depth.source import DepthSource, Shaped, log_left_out, with_least_confidence
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene

_VGA = (640, 480)


@dataclass(frozen=True)
class Frame:
    """One frame: the photo, its pose (camera-to-world, OpenCV axes), its K, and its depth map if it has one."""

    photo: Path
    camera_to_world: np.ndarray
    K: np.ndarray
    depth: Path | Shaped | None = None
    confidence: Path | Shaped | None = None
    placement: Placement | None = None
    pixel_center: float = 0.5


@dataclass(frozen=True)
class Depth:
    """What all depth maps of a recording have in common: see DepthSource; `unit` in words."""

    scale: float
    unit: str
    invalid: float | None = None


def scene_of(folder: Path, frames: Sequence[Frame], depth: Depth, source: str) -> Scene:
    """The scene; frames whose pose is not finite (lost tracking) are left out and counted."""
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
            frame.depth, (width, height), depth.scale, frame.placement, frame.confidence, invalid=depth.invalid))
    depths = with_least_confidence(depths, source)
    log_left_out(depths, source)
    return Scene(views, source, depths=tuple(depths) if any(depths) else None, depth_unit=depth.unit)


def holds(path: Path, mark: bytes) -> bool:
    """Whether the mark is in a file; false where it cannot be read."""
    try:
        return mark in untrusted.read_bytes(path)
    except InputError:
        return False


def by_number(folder: Path) -> list[Path]:
    """Photos whose names are numbers, in the order of these: 2.jpg before 10.jpg."""
    return sorted(photos.list_photos(folder), key=lambda path: (len(path.stem), path.stem))


def read_pose(path: Path) -> np.ndarray:
    """(4, 4) of a text file, float64; NaN where it holds inf or nan, which frames without a pose have."""
    tokens = untrusted.read_text(path, 1 << 16).split()
    if len(tokens) != 16:
        raise InputError(f"{path} holds {len(tokens)} numbers, expected 4 x 4")
    if any(token.lower().lstrip("+-") in ("inf", "nan", "infinity") for token in tokens):
        return np.full((4, 4), np.nan)
    return untrusted.floats(tokens, str(path)).reshape(4, 4)


def K_of(path: Path) -> np.ndarray:
    """K (3, 3) of a text file that holds 3 x 3 or 4 x 4 numbers."""
    tokens = untrusted.read_text(path, 1 << 16).split()
    side = {9: 3, 16: 4}.get(len(tokens), 0)
    if not side:
        raise InputError(f"{path} holds {len(tokens)} numbers, expected 3 x 3 or 4 x 4")
    return untrusted.floats(tokens, str(path)).reshape(side, side)[:3, :3]


def K_or_default(folder: Path, names: Sequence[str], photo: Path, default: np.ndarray) -> np.ndarray:
    """K of the first of the files `names`; else the `default` of a data set whose photos are 640 x 480."""
    path = photos.first_file(folder, names)
    if path is not None:
        return K_of(path)
    size = photos.photo_size(photo)
    if size != _VGA:
        raise InputError(f"{folder} has no {names[0]} and photos of {size[0]} x {size[1]}, expected {_VGA[0]} x "
                         f"{_VGA[1]} for the data set's own intrinsics; put the file (3 x 3) there")
    return default


def placed(K: np.ndarray, depth_K: np.ndarray) -> Placement:
    """How the photo lies in the depth map of a camera at the same place, by their intrinsics (3, 3)."""
    scale = depth_K[0, 0] / K[0, 0], depth_K[1, 1] / K[1, 1]
    if not (np.isfinite(scale).all() and min(scale) > 0):
        raise InputError("the focal lengths of photo and depth map are not above 0")
    return Placement(scale, (depth_K[0, 2] - scale[0] * K[0, 2], depth_K[1, 2] - scale[1] * K[1, 2]), "by intrinsics")
