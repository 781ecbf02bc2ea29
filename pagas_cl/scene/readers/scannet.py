"""ScanNet as its SensReader exports it: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_*.txt`.

Convention: pose camera-to-world, metres, OpenCV; -inf where tracking was lost; depth in millimetres, of a camera with
intrinsics of its own at the place of the colour camera; pixel centres are not said, and read at +0.5.
"""

from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import rgbd
from pagas_cl.scene.view import Scene

EXPECTED = "export of ScanNet's SensReader: looked for color/, pose/ and intrinsic/intrinsic_color.txt"
_COLOR_K = "intrinsic/intrinsic_color.txt"
_DEPTH_K = "intrinsic/intrinsic_depth.txt"


def detect(folder: Path) -> Path | None:
    """The intrinsics of the colour camera, where color/ and pose/ are there too."""
    there = (folder / _COLOR_K).is_file() and (folder / "pose").is_dir() and (folder / "color").is_dir()
    return folder / _COLOR_K if there else None


def read(folder: Path, color_K: Path) -> Scene:
    """Read the frames that have a photo and a pose, by number."""
    K = rgbd.K_of(color_K)
    placement = rgbd.placed(K, rgbd.K_of(folder / _DEPTH_K)) if (folder / _DEPTH_K).is_file() else None
    frames = []
    for photo in rgbd.by_number(folder / "color"):
        pose = folder / "pose" / f"{photo.stem}.txt"
        depth = folder / "depth" / f"{photo.stem}.png"
        if not pose.is_file():
            raise InputError(f"{photo}: its pose {pose} is missing")
        frames.append(rgbd.Frame(photo, rgbd.read_pose(pose), K, depth if depth.is_file() else None,
                                 placement=placement))
    if not frames:
        raise InputError(f"{folder / 'color'} has no photos")
    return rgbd.scene_of(folder, frames, rgbd.Depth(1000.0, "millimetres, as the format says"), f"{folder} (ScanNet)")
