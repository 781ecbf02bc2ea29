"""Writes pagas_cl/app/recorded_step.npz, what a device is tried with: a small scene, its gradients by the twins.

    python tests/support/recorded_step.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.hard_check import changed, normalized, twin_gradient
from support.hard_scenes import HardScene, base

from pagas_cl.app import device_check
from pagas_cl.app.device_check import RecordedStep

FILE = Path(device_check.__file__).with_name("recorded_step.npz")
SIZE = (80, 32)           # every vectorised path is taken from 74 x 26 pixels on (splat/options.py)


def made() -> dict[str, np.ndarray]:
    """The arrays of the file, but for the gradients."""
    scene = base(size=SIZE)
    initial, scene_scale = normalized(scene)
    views = [scene.target, *scene.contexts]
    return {"photos": np.stack([view.image for view in views]),
            "poses": np.stack([view.camera.world_to_camera for view in views]),
            "intrinsics": np.array([(c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in views)]),
            "scene_scale": np.float64(scene_scale), "initial": initial, "at": changed(initial, 1e-3)}


def twin_gradients(step: RecordedStep) -> np.ndarray:
    """What the twins give for the recorded scene, float32 (number of settings, H, W)."""
    scene = HardScene(step.target, step.contexts, step.initial)
    found = [twin_gradient(scene, config, step.initial, step.at, step.scene_scale)[0]
             for config in device_check.SETTINGS.values()]
    return np.stack(found).astype(np.float32)


if __name__ == "__main__":
    arrays = made()
    np.savez_compressed(FILE, **arrays, gradients=np.zeros((0, *arrays["at"].shape), np.float32))
    np.savez_compressed(FILE, **arrays, gradients=twin_gradients(RecordedStep.load()))
