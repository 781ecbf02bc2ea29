"""7-Scenes, and KinectFusion recordings of the same form: `frame-NNNNNN.color.png`, `.depth.png`, `.pose.txt`.

Convention: pose camera-to-world, metres, OpenCV; depth in millimetres, 65535 = none. Intrinsics are
`camera-intrinsics.txt` (3 x 3), else those that the data set's page states: 585 pixels, principal point (320, 240). In
7-Scenes depth is not registered to colour.
"""

from pathlib import Path

from pagas_cl.errors import InputError, log
from pagas_cl.scene.camera import intrinsics
from pagas_cl.scene.readers import photos, rgbd
from pagas_cl.scene.view import Scene

INTRINSICS = ("camera-intrinsics.txt", "intrinsics.txt", "K.txt", "../camera-intrinsics.txt")
_KINECT = intrinsics(585.0, 585.0, 320.0, 240.0)
_COLOR = (".color.png", ".color.jpg")
_PLACES = (".", "data", "seq-01")
EXPECTED = f"frame-NNNNNN.pose.txt (looked in {', '.join(_PLACES)})"


def detect(folder: Path) -> Path | None:
    """Where there are frame-*.pose.txt: the folder, data/ or seq-01/; or None."""
    return next((folder / name for name in _PLACES if (folder / name).is_dir()
                 and next((folder / name).glob("frame-*.pose.txt"), None) is not None), None)


def read(folder: Path, place: Path) -> Scene:
    """Read the frames."""
    others = sorted(path.name for path in folder.glob("seq-*") if path.is_dir() and path != place)
    if others:
        log.warning("%s is read; %s are other sequences and are not: name one as the scene to read it", place,
                    ", ".join(others[:5]))
    source = f"{place} (7-Scenes, KinectFusion)"
    frames = []
    for pose in sorted(place.glob("frame-*.pose.txt")):
        stem = pose.name.removesuffix(".pose.txt")
        photo = photos.first_file(place, (stem + suffix for suffix in _COLOR))
        if photo is None:
            raise InputError(f"{pose}: its photo {stem}{_COLOR[0]} is missing")
        frames.append(rgbd.Frame(photo, rgbd.read_pose(pose), rgbd.K_or_default(place, INTRINSICS, photo, _KINECT),
                                 photos.first_file(place, (stem + ".depth.png",))))
    if photos.first_file(place, INTRINSICS) is None:
        log.warning("%s: no camera-intrinsics.txt; the data set's 585 pixels are taken, and its depth is not "
                    "registered to the photos: expect them to be off by some pixels", source)
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says", invalid=65535), source)
