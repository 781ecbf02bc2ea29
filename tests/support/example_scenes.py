"""A small scene in the form that another program leaves, for its reader to be tried on."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from support.exports_depth import EXPORTS
from support.frames import Frame
from support.synthetic.scene import SyntheticScene

from pagas_cl.errors import InputError
from pagas_cl.scene.depthmap import depth_up, save_depth

METRES = 0.005       # of a unit of the scene: depths of about 3 m, in which millimetres are fine enough
NETWORKS = ("da3", "da3-npy", "da3-colmap", "vggt", "vggt-colmap", "mapanything", "mapanything-colmap", "mvsanywhere")


def frames_of(synthetic: SyntheticScene, unit: float = METRES) -> list[Frame]:
    """Photos, cameras and the coarse depth of the views that are not held out, lengths times `unit`."""
    found = []
    for k, view in enumerate(synthetic.views):
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] *= unit
        camera = replace(view.camera, world_to_camera=pose, name="")
        found.append(Frame(camera, synthetic.image(k), synthetic.initial_depth(view.camera) * np.float32(unit)))
    return found


def as_network(frames: Sequence[Frame], *, scales: float = 0.2, shifts: float = 0.05, noise: float = 0.002,
               holes: float = 0.03, seed: int = 0) -> list[Frame]:
    """The same with depth as feed-forward networks leave it.

    A factor a view within 1 +- `scales`, a shift within +- `shifts` of the median depth, errors that neighbours share
    (blobs of an eighth of a side; standard deviation `noise` of the depth), and `holes`: the share of the pixels
    without depth, where the confidence is lowest.
    """
    rng, found = np.random.default_rng(seed), []
    for frame in frames:
        factor, shift = 1 + scales * rng.uniform(-1, 1), shifts * rng.uniform(-1, 1)
        rough, unsure = (depth_up(2 + rng.normal(size=(9, 12)).clip(-1.9, 1.9).astype(np.float32),
                                  *frame.depth.shape[::-1]) - 2 for _ in range(2))
        middle = np.median(frame.depth[frame.depth > 0])
        depth = frame.depth * (1 + noise * rough / max(float(rough.std()), 1e-6)) * factor + shift * middle
        low = np.quantile(unsure, holes)
        confidence = 1 + np.exp(np.minimum(unsure - low, 1)).astype(np.float32)
        kept = (frame.depth > 0) & (unsure > low)
        found.append(replace(frame, depth=np.where(kept, depth, 0).astype(np.float32), confidence=confidence))
    return found


def write_example(folder: Path, format: str, synthetic: SyntheticScene) -> Path:
    """Write `folder` as the program behind `format` (of exports_depth.EXPORTS) would, and the exact depth maps in
    depth_true/, by number; returns the folder. InputError where it holds something already."""
    if format not in EXPORTS:
        raise InputError(f"unknown format {format!r} of an example, expected one of {', '.join(EXPORTS)}")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{str(folder)!r} is not empty: give a new folder for the example")
    folder.mkdir(parents=True, exist_ok=True)
    frames = frames_of(synthetic)
    EXPORTS[format](folder, as_network(frames) if format in NETWORKS else frames)
    for k, view in enumerate(synthetic.views):
        save_depth(folder / "depth_true" / f"{k:06d}.npz", synthetic.true_depth(view.camera) * np.float32(METRES))
    return folder
