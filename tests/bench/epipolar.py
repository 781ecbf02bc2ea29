"""Epipolar residuals of features that took no part, with the cameras as given and refined: `--real` scenes' photos.

    python tests/bench/epipolar.py dtu_scan24 --mesh dtu_scan24/derived/mesh_coarse.ply --share 0.33

SIFT features (scikit-image) of neighbouring photos, matched both ways with a ratio of 0.7; distance of a match from its
epipolar line, mean of both photos, pixels; matches beyond 5 pixels with both cameras are taken to be wrong.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

WRONG, NEIGHBOURS = 5.0, 3


def features(photo):
    """Places (n, 2), x right and y down from the corner, and descriptors."""
    from skimage.feature import SIFT

    grey = photo.astype(np.float64).mean(axis=-1) / 255
    sift = SIFT()
    sift.detect_and_extract(grey)
    return sift.positions[:, ::-1] + 0.5, sift.descriptors


def distances(one, other, here, there) -> np.ndarray:
    """Of matches (n, 2) from the epipolar lines of the other photo, mean of both photos, pixels."""
    from pagas_cl.method.cameras.motion import cross_matrix
    from pagas_cl.scene.camera import intrinsics

    rotation, tau = other.relative_to(one)
    inverse = [np.linalg.inv(intrinsics(c.fx, c.fy, c.cx, c.cy)) for c in (one, other)]
    F = inverse[1].T @ cross_matrix(tau / max(np.linalg.norm(tau), 1e-12)) @ rotation @ inverse[0]
    a, b = (np.c_[points, np.ones(len(points))] for points in (here, there))
    lines = a @ F.T, b @ F
    off = np.abs((b * lines[0]).sum(-1))
    return 0.5 * sum(off / np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-12) for line in lines)


def residuals(views, given, refined) -> np.ndarray:
    """Of all matches of each view with its neighbours by the cameras' angle: before and after, (n, 2)."""
    from skimage.feature import match_descriptors

    found = [features(view.load_image()) for view in views]
    axes, out = np.array([camera.direction for camera in given]), []
    for i in range(len(views)):
        for j in np.argsort(-axes @ axes[i], kind="stable")[1:1 + NEIGHBOURS]:
            if i < j or i not in np.argsort(-axes @ axes[j], kind="stable")[1:1 + NEIGHBOURS]:
                pairs = match_descriptors(found[i][1], found[j][1], max_ratio=0.7, cross_check=True)
                here, there = found[i][0][pairs[:, 0]], found[j][0][pairs[:, 1]]
                both = np.stack([distances(cameras[i], cameras[j], here, there) for cameras in (given, refined)], -1)
                out.append(both[both.min(axis=1) < WRONG])
    return np.concatenate(out)


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("scene", type=Path)
    parse.add_argument("--mesh", type=Path)
    parse.add_argument("--depth-dir", type=Path)
    parse.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parse.add_argument("--device")
    ask = parse.parse_args()
    from real import load

    from pagas_cl.method.cameras.refine import refine_cameras

    views, depths = load(ask.scene, ask.mesh, ask.depth_dir, ask.share)
    found = refine_cameras(views, depths, device=ask.device)
    both = residuals(views, [view.camera for view in views], found.cameras)
    sys.stdout.write(f"{found}\n{len(both)} matches: median {np.median(both[:, 0]):.3f} pixels before, "
                     f"{np.median(both[:, 1]):.3f} after; means {both[:, 0].mean():.3f}, {both[:, 1].mean():.3f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
