"""7-Scenes, and KinectFusion recordings of the same form: `frame-NNNNNN.color.png`, `.depth.png`, `.pose.txt`.

Convention: pose camera-to-world, metres, OpenCV; depth in millimetres, 65535 = none. Intrinsics are
`camera-intrinsics.txt` (3 x 3), else those that the data set's page states: 585 pixels, principal point (320, 240). In
7-Scenes depth is not registered to colour.
"""

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.scene.camera import intrinsics
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene

INTRINSICS = ("camera-intrinsics.txt", "intrinsics.txt", "K.txt", "../camera-intrinsics.txt")
_KINECT, _SIZE = (585.0, 585.0, 320.0, 240.0), (640, 480)
_COLOR = (".color.png", ".color.jpg")
_PLACES = (".", "data", "seq-01")


def detect(folder: Path) -> Path | None:
    """Where there are frame-*.pose.txt: the folder, data/ or seq-01/; or None."""
    return next((folder / name for name in _PLACES if (folder / name).is_dir()
                 and next((folder / name).glob("frame-*.pose.txt"), None) is not None), None)


def read(folder: Path) -> Scene:
    """Read the frames."""
    place = detect(folder)
    if place is None:
        raise InputError(f"{folder} has no frame-NNNNNN.pose.txt (looked in {', '.join(_PLACES)})")
    others = sorted(path.name for path in folder.glob("seq-*") if path.is_dir() and path != place)
    if others:
        log.warning("%s is read; %s are other sequences and are not: name one as the scene to read it", place,
                    ", ".join(others[:5]))
    path = photos.first_file(place, INTRINSICS)
    source = f"{place} (7-Scenes, KinectFusion)"
    frames = []
    for pose in sorted(place.glob("frame-*.pose.txt")):
        stem = pose.name.removesuffix(".pose.txt")
        photo = photos.first_file(place, (stem + suffix for suffix in _COLOR))
        if photo is None:
            raise InputError(f"{pose}: its photo {stem}{_COLOR[0]} is missing")
        frames.append(rgbd.Frame(photo, rgbd.read_pose(pose), _K(path, photo),
                                 photos.first_file(place, (stem + ".depth.png",))))
    if path is None:
        log.warning("%s: no camera-intrinsics.txt; the data set's 585 pixels are taken, and its depth is not "
                    "registered to the photos: expect them to be off by some pixels", source)
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says", invalid=65535), source)


def _K(path: Path | None, photo: Path) -> np.ndarray:
    if path is not None:
        return rgbd.K_of(path)
    size = photos.photo_size(photo)
    if size != _SIZE:
        raise InputError(f"{photo.parent} has no {INTRINSICS[0]} and photos of {size[0]} x {size[1]}, expected "
                         f"{_SIZE[0]} x {_SIZE[1]} for the data set's own intrinsics; put the file there")
    return intrinsics(*_KINECT)
