"""A made RGB-D recording by a moving camera, in the form of hololens_rgbd (real.py and cameras.py read it).

    python tests/bench/recording.py OUT [--frames 32] [--width 540] [--off 1] [--rows 0]
    python tests/bench/cameras.py TABLE --real OUT --views 24

A relief in metres, seen on a sweep from side to side that comes nearer and goes back; photos with sensor noise and an
exposure each of its own (15 %); poses that drift (a random walk whose end is `--off` pixels away, and a tenth of that
each by itself); with `--rows` the rows of every eighth photo moved by up to so many pixels, in waves, as by a camera
that shakes while it reads them out. Depth as a time-of-flight sensor leaves it: half the photos' size, 0.2 % of the
depth that neighbours share, 2 mm a pixel, whole millimetres, none within two pixels of a depth edge.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image
from scipy.ndimage import map_coordinates

from pagas_cl.app.synthetic import relief_scene
from pagas_cl.app.synthetic.examples import METRES
from pagas_cl.method.cameras.motion import moved
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import depth_up

DISTANCE = 650.0          # of the camera from the relief, in the scene's units


def track(first: Camera, frames: int) -> list[Camera]:
    """Cameras that look at the middle of the relief, swept by 50 degrees, 10 % nearer in the middle."""
    found = []
    for k, t in enumerate(np.linspace(-1, 1, frames)):
        across, down = np.radians(25 * t), np.radians(6 * np.sin(3 * t))
        away = DISTANCE * (0.9 + 0.1 * t * t)
        eye = away * np.array([np.sin(across) * np.cos(down), np.sin(down), -np.cos(across) * np.cos(down)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ eye
        found.append(replace(first, world_to_camera=pose, name=f"{k:05d}"))
    return found


def drifted(cameras: list[Camera], pixels: float, rng) -> list[Camera]:
    """A walk of small steps, and jitter."""
    step = pixels / 1.83 / cameras[0].fx
    walk = np.cumsum(rng.normal(size=(len(cameras), 6)), axis=0) / np.sqrt(len(cameras))
    size = np.array([1, 1, 1, DISTANCE, DISTANCE, DISTANCE]) * step
    return [moved(camera, (row + 0.1 * rng.normal(size=6)) * size) for camera, row in zip(cameras, walk)]


def sensed(depth: np.ndarray, rng) -> np.ndarray:
    """Millimetres, uint16, of the photo's size, from a sensor of half of it; 0 = none."""
    coarse = depth[::2, ::2] * METRES * 1000
    around = sliding_window_view(np.pad(coarse, 2, mode="edge"), (5, 5))
    edge = around.max(axis=(2, 3)) - around.min(axis=(2, 3)) > 0.03 * coarse
    rough = depth_up(3 + rng.normal(size=(9, 12)).clip(-2.9, 2.9).astype(np.float32), *coarse.shape[::-1]) - 3
    measured = coarse * (1 + 0.002 * rough) + 2.0 * rng.normal(size=coarse.shape)
    whole = np.where((coarse > 0) & ~edge, np.rint(measured), 0).astype(np.uint16)
    return whole.repeat(2, 0).repeat(2, 1)[:depth.shape[0], :depth.shape[1]]


def shaken(photo: np.ndarray, pixels: float, rng) -> np.ndarray:
    """The photo with its rows moved along both axes, by sums of two waves whose largest is `pixels`."""
    height, width = photo.shape[:2]
    at = np.arange(height) / height
    waves = np.sin(2 * np.pi * (np.outer(rng.uniform(0.5, 1.5, 4), at) + rng.uniform(size=(4, 1))))
    moves = waves[:2] + 0.5 * waves[2:]
    moves *= pixels / np.hypot(*moves).max()
    rows, columns = np.mgrid[:height, :width] + moves[::-1, :, None]
    return np.stack([map_coordinates(photo[..., k], (rows, columns), mode="nearest") for k in range(3)], -1)


def write(folder: Path, frames: int, width: int, off: float, seed: int, rows: float = 0.0) -> None:
    """images, depth, depth_true (metres), K.txt and poses.txt (camera to world, integer pixel centres)."""
    made = relief_scene(width, round(width * 2 / 3), 1, held_out=0, seed=seed, noise=2.0)
    made = replace(made, cameras=track(made.cameras[0], frames))
    rng = np.random.default_rng([seed, 11])
    for name in ("images", "depth", "depth_true"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    poses = []
    for k, (camera, given) in enumerate(zip(made.cameras, drifted(made.cameras, off, rng))):
        truth = made.true_depth(camera)
        photo = made.image(k) * np.exp(rng.uniform(-0.15, 0.15))
        if rows and k % 8 == 4:
            photo = shaken(photo, rows, np.random.default_rng([seed, 12, k]))
        photo = photo.clip(0, 255).round().astype(np.uint8)
        Image.fromarray(photo).save(folder / "images" / f"{camera.name}.png")
        Image.fromarray(sensed(truth, rng)).save(folder / "depth" / f"{camera.name}.png")
        np.savez_compressed(folder / "depth_true" / f"{camera.name}.npz", depth=truth * np.float32(METRES))
        pose = given.world_to_camera.copy()
        pose[:3, 3] *= METRES
        poses.append(np.linalg.inv(pose).ravel())
    np.savetxt(folder / "poses.txt", poses)
    first = made.cameras[0]
    np.savetxt(folder / "K.txt", [[first.fx, 0, first.cx - 0.5], [0, first.fy, first.cy - 0.5], [0, 0, 1]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--width", type=int, default=540)
    parser.add_argument("--off", type=float, default=1.0, help="pixels that the last pose is off by")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rows", type=float, default=0.0, help="pixels that rows of every eighth photo are moved by")
    given = parser.parse_args()
    write(given.out, given.frames, given.width, given.off, given.seed, given.rows)


if __name__ == "__main__":
    main()
