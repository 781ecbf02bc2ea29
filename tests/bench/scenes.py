"""Write the scenes that accuracy against time is measured on: `python tests/bench/scenes.py OUT [--data DIR]`.

OUT/relief, OUT/bar: synthetic scenes with exact truth. With --data (the folder of real scenes): OUT/motorcycle,
Middlebury 2014 with dense truth and one context view; OUT/dtu, 16 views of DTU scan 24 at half size, the initial depth
from its coarse mesh, no truth. Each has images/, cameras.json, depth_initial/ and, where there is truth, depth_true/.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from PIL import Image
from scipy import ndimage
from support.synthetic import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import resize_depth, save_depth
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View

# photos; file of the disparities, grey values a pixel; focal length, principal point and the right camera's offset,
# pixels; baseline, mm. Middlebury counts pixels from their centres.
PAIRS = {
    "motorcycle": ("motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz", 1,
                   994.978, 311.193, 254.877, 31.086, 193.001),
    "adirondack": ("Adirondack_left.png", "Adirondack_right.png", "Adirondack_gt.png", 1,
                   4161.221 / 4, 1445.577 / 4, 984.686 / 4, 209.059 / 4, 176.252),
    "adirondack, other exposure": ("Adirondack_left.png", "AdirondackE_right.png", "Adirondack_gt.png", 1,
                                   4161.221 / 4, 1445.577 / 4, 984.686 / 4, 209.059 / 4, 176.252),
    "art": ("view1.png", "view5.png", "disp1.png", 3, 3740 / 3, 231, 185, None, 160),
    "dolls": ("view1.png", "view5.png", "disp1.png", 3, 3740 / 3, 231, 185, None, 160),
    "cones": ("im2.png", "im6.png", "disp2.png", 4, 1000, 225, 187, 0, 160),
}
JUMP, ROUGH_JUMP = 1, 2     # pixels of disparity between neighbours of two surfaces; where the truth is of whole pixels
LEAST_SURFACE = 400         # pixels


def middlebury_pair(data: Path, name: str, share: float = 1.0):
    """Target and context of a Middlebury pair, initial and true depth, at `share` of its size.

    The initial depth is the truth smoothed inside surfaces (sigma 8 px) plus a smooth error of half a pixel. Truth of
    whole grey values is smoothed by 2 px inside surfaces.
    """
    left, right, truth, greys, focal, cx, cy, offset, baseline = PAIRS[name]
    folder = data / "middlebury_stereo" / name.split(",")[0]
    photos = [np.asarray(Image.open(folder / side).convert("RGB")) for side in (left, right)]
    if offset is None:
        offset = int((folder / "dmin.txt").read_text()) / 3
    if truth.endswith("npz"):
        disparity = np.load(folder / truth)["arr_0"].astype(float)
    else:
        disparity = np.asarray(Image.open(folder / truth).convert("L")).astype(float) / greys
    start, known = _coarse(disparity)
    known &= disparity > 0
    fine = disparity if truth.endswith("npz") else _smoothed_inside(disparity, known, 2.0)
    maps = [np.where(known, focal * baseline / np.where(known, values + offset, 1), 0).astype(np.float32)
            for values in (start, fine)]
    height, width = disparity.shape
    pose = np.eye(4)
    pose[0, 3] = -baseline
    cameras = [Camera(width, height, focal, focal, cx + 0.5, cy + 0.5, np.eye(4), "left"),
               Camera(width, height, focal, focal, cx + offset + 0.5, cy + 0.5, pose, "right")]
    views = [smaller(View(camera, photo, name=f"{camera.name}.png"), share) for camera, photo in zip(cameras, photos)]
    return views, *(resize_depth(each, views[0].camera.width, views[0].camera.height) for each in maps)


def _jumps(disparity, known, least: float):
    """Pixels next to a depth edge."""
    filled, jump = np.where(known, disparity, 0), np.zeros_like(known)
    for axis in (0, 1):
        step = np.abs(np.diff(filled, axis=axis)) > least
        for shift in (slice(1, None), slice(None, -1)):
            jump[(shift, slice(None)) if axis == 0 else (slice(None), shift)] |= step
    return jump


def _coarse(disparity):
    """Disparity smoothed inside surfaces plus half a pixel of smooth error, and where it is known."""

    known = np.isfinite(disparity) & (disparity > 0)
    filled = np.where(known, disparity, 0)
    labels, _ = ndimage.label(known & ~_jumps(disparity, known, JUMP))
    out, kept = disparity.copy(), np.zeros_like(known)
    for label, place in enumerate(ndimage.find_objects(labels), 1):
        around = tuple(slice(max(0, s.start - 32), s.stop + 32) for s in place)
        inside = labels[around] == label
        if inside.sum() < LEAST_SURFACE:
            continue
        weight = ndimage.gaussian_filter(inside.astype(float), 8.0)
        value = ndimage.gaussian_filter(inside * filled[around], 8.0)
        out[around][inside] = (value / np.maximum(weight, 1e-9))[inside]
        kept[around][inside] = True
    error = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=disparity.shape), 60.0)
    return np.where(kept, out + 0.5 * error / np.abs(error).mean(), 0), kept


def _smoothed_inside(values, known, sigma: float):
    """Averaged with neighbours of the same surface."""

    out, use = values.copy(), known & ~_jumps(values, np.ones_like(known), ROUGH_JUMP)
    weight, value = (ndimage.gaussian_filter(x, sigma) for x in (use.astype(float), use * values))
    out[use] = (value / np.maximum(weight, 1e-9))[use]
    return out


def smaller(view: View, share: float) -> View:
    """The view with its photo in memory, at a share of the size; without a mask where that is not 1."""
    pixels = view.load_image()
    if share == 1:
        return replace(view, image=pixels)
    size = round(view.camera.width * share), round(view.camera.height * share)
    photo = np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))
    return replace(view, image=photo, mask=None, camera=view.camera.resized(*size))


def motorcycle(data: Path, out: Path, share: float) -> None:
    """Middlebury's pair with dense truth."""
    views, initial, truth = middlebury_pair(data, "motorcycle", share)
    _write(out, views, {"left": {"depth_initial": initial, "depth_true": truth}})


def dtu(data: Path, out: Path, share: float) -> None:
    """DTU scan 24; needs Open3D and pycolmap."""
    from pagas_cl.refine import initial_depths
    from pagas_cl.scene.meshes.kinds import to_surface
    from pagas_cl.scene.readers import read_scene

    folder = data / "dtu_scan24"
    views = read_scene(folder).views
    depths = initial_depths(to_surface(folder / "derived" / "mesh_coarse.ply"), views)
    small = [smaller(replace(view, mask=None), share) for view in views]
    _write(out, small, {view.stem: {"depth_initial": resize_depth(depth, view.camera.width, view.camera.height)}
                        for view, depth in zip(small, depths)})


def _write(out: Path, views, depths) -> None:
    (out / "images").mkdir(parents=True, exist_ok=True)
    for view in views:
        Image.fromarray(view.load_image()).save(out / "images" / f"{view.stem}.png")
        for kind, depth in depths.get(view.stem, {}).items():
            save_depth(out / kind / f"{view.stem}.npz", depth)
    camera_file.write(out, [replace(view, name=f"{view.stem}.png") for view in views])


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
