"""Real pairs with dense truth (Middlebury): errors of depth and normals before and after, and whether deviations hold.

    python tests/bench/middlebury.py ../shared/data/middlebury_stereo [--share 0.5] [--pairs motorcycle ...]
        [--set STAGE.FIELD=VALUE ...] [--set ... for another row]

The initial depth is the truth smoothed inside surfaces (8 px) plus a smooth error of half a pixel (scenes.py). Truth of
all pairs but the motorcycle is of whole grey values, a third or a quarter of a pixel, or (adirondack) a pixel: it is
smoothed by 2 px inside surfaces, and normals are compared with those of that.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from scenes import BASELINE, CENTER_X, CENTER_Y, FOCAL, OFFSET, _smoothed
from scipy import ndimage

from pagas_cl.app.evaluate import compare_depth
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.view import View

# photos, map of disparities, grey values a pixel, focal length, principal point, offset, baseline
PAIRS = {
    "motorcycle": ("motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz", 1,
                   FOCAL, CENTER_X, CENTER_Y, OFFSET, BASELINE),
    "adirondack": ("Adirondack_left.png", "Adirondack_right.png", "Adirondack_gt.png", 1,
                   4161.221 / 4, 1445.577 / 4, 984.686 / 4, 209.059 / 4, 176.252),
    "adirondack, other exposure": ("Adirondack_left.png", "AdirondackE_right.png", "Adirondack_gt.png", 1,
                                   4161.221 / 4, 1445.577 / 4, 984.686 / 4, 209.059 / 4, 176.252),
    "art": ("view1.png", "view5.png", "disp1.png", 3, 3740 / 3, 231, 185, None, 160),
    "dolls": ("view1.png", "view5.png", "disp1.png", 3, 3740 / 3, 231, 185, None, 160),
    "cones": ("im2.png", "im6.png", "disp2.png", 4, 1000, 225, 187, 0, 160),
}


def pair(data: Path, name: str, share: float):
    """Target, context, initial and true depth, true depth for normals (smoothed where it is of whole grey values)."""
    left, right, truth, greys, focal, cx, cy, offset, baseline = PAIRS[name]
    folder = data / name.split(",")[0]
    photos = [np.asarray(Image.open(folder / side).convert("RGB")) for side in (left, right)]
    if offset is None:
        offset = int((folder / "dmin.txt").read_text()) / 3
    if truth.endswith("npz"):
        disparity = np.load(folder / truth)["arr_0"].astype(float)
    else:
        disparity = np.asarray(Image.open(folder / truth).convert("L")).astype(float) / greys
    start, known = _smoothed(disparity)
    fine = disparity if greys == 1 and truth.endswith("npz") else _inside(disparity, known, 2.0)
    height, width = disparity.shape
    pose = np.eye(4)
    pose[0, 3] = -baseline
    cameras = [Camera(width, height, focal, focal, cx + 0.5, cy + 0.5, np.eye(4), "left"),
               Camera(width, height, focal, focal, cx + offset + 0.5, cy + 0.5, pose, "right")]
    known &= disparity > 0
    maps = [np.where(known, focal * baseline / np.where(known, values + offset, 1), 0).astype(np.float32)
            for values in (start, fine)]
    size = round(width * share), round(height * share)
    views = [View(camera.resized(*size), np.asarray(Image.fromarray(photo).resize(size, Image.BOX)),
                  name=f"{camera.name}.png") for camera, photo in zip(cameras, photos)]
    return views, *(maps if share == 1 else [_resized(each, *size) for each in maps])


def _resized(depth, width, height):
    from pagas_cl.scene.depthmap import resize_depth

    return resize_depth(depth, width, height)


def _inside(values, known, sigma: float):
    """Averaged with neighbours of the same surface."""
    out = values.copy()
    jump = np.zeros_like(known)
    for axis in (0, 1):
        step = np.abs(np.diff(values, axis=axis)) > 2
        for shift in (slice(1, None), slice(None, -1)):
            jump[(shift, slice(None)) if axis == 0 else (slice(None), shift)] |= step
    use = known & ~jump
    weight, value = (ndimage.gaussian_filter(x, sigma) for x in (use.astype(float), use * values))
    out[use] = (value / np.maximum(weight, 1e-9))[use]
    return out


def measured(views, start, truth, config, device):
    """Depth (px, mean) and normals (degrees, mean) of input and result, away from depth edges; share of pixels within
    one and two deviations; share of rejected."""
    camera = views[0].camera
    result = refine_depth(views[0], views[1:], start, config=config, device=device)
    shift = truth**2 / (camera.fx * abs(views[1].camera.center[0] - camera.center[0]))
    parallax = np.where(truth > 0, shift, np.nan)
    rows = [compare_depth(each, truth, camera, parallax=parallax, mask=(truth > 0) & (start > 0)).smooth
            for each in (start, result.depth)]
    ok = (result.status == 1) & (truth > 0) & np.isfinite(result.deviation)
    ratio = np.abs(result.depth - truth)[ok] / result.deviation[ok]
    counts = result.counts
    rejected = counts["rejected"] / max(1, counts["rejected"] + counts["refined"])
    return rows, [np.mean(ratio < n) for n in (1, 2)], rejected, result


def main():
    from pagas_cl.config.assignments import build_config

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--pairs", nargs="*", default=list(PAIRS))
    parser.add_argument("--set", nargs="*", action="append", default=[], dest="settings")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    device = open_device(given.device)
    print("| pair | settings | mismatch | depth, px | normals | of the input's | within 1, 2 deviations | rejected |")
    print("|---|---|---|---|---|---|---|---|")
    for name in given.pairs:
        views, start, truth = pair(given.data, name, given.share)
        for settings in given.settings or [[]]:
            config = build_config("balanced", settings)
            (before, after), within, rejected, result = measured(views, start, truth, config, device)
            raised = [f"{e['evidence']:.2f}" for e in result.report["effects"] if e["effect"] == "mismatch"]
            print(f"| {name} | {' '.join(settings)} | {' '.join(raised)} | "
                  f"{before.mean_parallax:.3f}, {after.mean_parallax:.3f} | "
                  f"{before.normal_mean:.1f}°, {after.normal_mean:.1f}° | "
                  f"{after.mean_parallax / before.mean_parallax:.2f}, {after.normal_mean / before.normal_mean:.2f} | "
                  f"{within[0]:.0%}, {within[1]:.0%} | {rejected:.1%} |", flush=True)


if __name__ == "__main__":
    main()
