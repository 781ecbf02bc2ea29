"""What readers of RGB-D recordings share: frames, those without a pose left out, as views with their depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene import untrusted
from pagas_cl.scene.depth.placement import Placement
from pagas_cl.scene.depth.source import DepthSource, Stored, with_least_confidence
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene


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
    """The scene; frames whose pose is not finite (lost tracking) are left out and counted. `scale`, `invalid` of all
    depth maps are those of a DepthSource, `unit` is in words."""
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


def by_number(folder: Path) -> list[Path]:
    """Photos whose names are numbers, in the order of these: 2.jpg before 10.jpg."""
    return sorted(photos.list_photos(folder), key=lambda path: (len(path.stem), path.stem))
