"""Write the scenes that accuracy against time is measured on: `python tests/bench/scenes.py OUT [--data DIR]`.

OUT/relief, OUT/bar: synthetic scenes with exact truth. With --data (the folder of real scenes): OUT/motorcycle,
Middlebury 2014 with dense truth and one context view,
the initial depth smoothed inside surfaces (sigma 8 px) plus a smooth error
of half a pixel; OUT/dtu, 16 views of DTU scan 24 at half size, the initial depth from its coarse mesh, no truth.
Each has images/, cameras.json, depth_initial/ and, where there is truth, depth_true/.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from pagas_cl.app.synthetic import relief_scene
from pagas_cl.app.synthetic.scene import write_scene
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import resize_depth, save_depth
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View

FOCAL, CENTER_X, CENTER_Y, OFFSET, BASELINE = 994.978, 311.193, 254.877, 31.086, 193.001  # px, px, px, px, mm


def motorcycle(data: Path, out: Path, scale: float) -> None:
    """Middlebury's pair; its calibration counts pixels from their centres, hence the halves."""
    folder = data / "middlebury_stereo" / "motorcycle"
    photos = [np.asarray(Image.open(folder / f"motorcycle_{side}.png").convert("RGB")) for side in ("left", "right")]
    disparity = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(float)
    start, known = _smoothed(disparity)
    height, width = disparity.shape
    pose = np.eye(4)
    pose[0, 3] = -BASELINE
    cameras = [Camera(width, height, FOCAL, FOCAL, CENTER_X + 0.5, CENTER_Y + 0.5, np.eye(4), "left"),
               Camera(width, height, FOCAL, FOCAL, CENTER_X + OFFSET + 0.5, CENTER_Y + 0.5, pose, "right")]
    views = [View(camera, photo, name=f"{camera.name}.png") for camera, photo in zip(cameras, photos)]
    depth = {name: np.where(known, FOCAL * BASELINE / np.where(known, values + OFFSET, 1), 0)
             for name, values in (("depth_initial", start), ("depth_true", disparity))}
    _write(out, views, {"left": depth}, scale)


def _smoothed(disparity):
    """Disparity smoothed inside surfaces plus half a pixel of smooth error, and where it is known."""
    known = np.isfinite(disparity) & (disparity > 0)
    filled = np.where(known, disparity, 0)
    jump = np.zeros_like(known)
    for axis in (0, 1):
        step = np.abs(np.diff(filled, axis=axis)) > 1
        for shift in (slice(1, None), slice(None, -1)):
            jump[(shift, slice(None)) if axis == 0 else (slice(None), shift)] |= step
    labels, number = ndimage.label(known & ~jump)
    out, kept = disparity.copy(), np.zeros_like(known)
    for label, place in enumerate(ndimage.find_objects(labels), 1):
        around = tuple(slice(max(0, s.start - 32), s.stop + 32) for s in place)
        inside = labels[around] == label
        if inside.sum() < 400:
            continue
        weight = ndimage.gaussian_filter(inside.astype(float), 8.0)
        value = ndimage.gaussian_filter(inside * filled[around], 8.0)
        out[around][inside] = (value / np.maximum(weight, 1e-9))[inside]
        kept[around][inside] = True
    error = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=disparity.shape), 60.0)
    return np.where(kept, out + 0.5 * error / np.abs(error).mean(), 0), kept


def dtu(data: Path, out: Path, scale: float) -> None:
    """DTU scan 24; needs Open3D and pycolmap."""
    from pagas_cl.refine import initial_depths
    from pagas_cl.scene.meshes.kinds import to_surface
    from pagas_cl.scene.readers import read_scene

    folder = data / "dtu_scan24"
    views = [replace(view, mask=None) for view in read_scene(folder).views]
    depths = initial_depths(to_surface(folder / "derived" / "mesh_coarse.ply"), views)
    _write(out, views, {v.stem: {"depth_initial": depth} for v, depth in zip(views, depths)}, scale)


def _write(out: Path, views, depths, scale: float) -> None:
    (out / "images").mkdir(parents=True, exist_ok=True)
    smaller = []
    for view in views:
        width, height = round(view.camera.width * scale), round(view.camera.height * scale)
        photo = Image.fromarray(view.load_image()).resize((width, height), Image.Resampling.BOX)
        photo.save(out / "images" / f"{view.stem}.png")
        smaller.append(View(view.camera.resized(width, height), np.asarray(photo), name=f"{view.stem}.png"))
        for kind, depth in depths.get(view.stem, {}).items():
            save_depth(out / kind / f"{view.stem}.npz", resize_depth(depth, width, height))
    camera_file.write(out, smaller)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--scale", type=float, default=1.0, help="of the synthetic scenes and of the real ones")
    given = parser.parse_args()
    width, height = round(1554 * given.scale), round(1162 * given.scale)
    write_scene(relief_scene(width, height, 10), given.out / "relief")
    write_scene(relief_scene(width // 2, height // 2, 10, bar=8.0, seed=1), given.out / "bar")
    if given.data is not None:
        motorcycle(given.data, given.out / "motorcycle", 1.0 if given.scale == 1 else 0.5)
        dtu(given.data, given.out / "dtu", 0.5 if given.scale == 1 else 0.25)


if __name__ == "__main__":
    main()
