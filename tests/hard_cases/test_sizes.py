"""Image sizes that crashed a driver: they run in a process of their own, so that a crash is a failed test, not a dead
one; it prints each size that it has done.

PoCL's loop over several work-items that each hold vectors of 16 pixels crashed in gather_gradient at 288 x 216 and 287
x 215 (segmentation fault); groups of one item do not have such a loop.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SIZES = [(288, 216), (287, 215), (161, 23), (31, 97)]
RUN = """
import sys
import numpy as np
from pagas_cl.config.presets import BALANCED
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.view import View
from pagas_cl.runtime.device import open_device
from pagas_cl.method.splat import PhotoStore, ViewInput, refine_levels

def end_well(w, h):
    row, column = np.mgrid[:h, :w]
    depth = (600 + 8 * np.sin(column / 9) * np.cos(row / 11)).astype(np.float32)
    photo = np.uint8(128 + 60 * np.stack([np.sin(column / k) * np.cos(row / (k + 1)) for k in (2, 3, 5)], axis=-1))
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 40
    target, *contexts = [View(Camera(w, h, w, w, w / 2, h / 2, pose), photo, None, str(k))
                         for k, pose in enumerate(poses)]
    for grey in (False, True):
        config = BALANCED.with_settings(pyramid__steps=(2,), loss__grey=grey)
        device = open_device()
        result = refine_levels(ViewInput(target, contexts, depth, device, PhotoStore(device)), config)
        assert np.isfinite(result.depth).all() and (result.depth[depth > 0] > 0).all()

for word in sys.argv[1:]:
    end_well(*map(int, word.split("x")))
    print("refined", word, flush=True)
"""


@pytest.fixture(scope="module")
def done(device):
    sizes = [f"{width}x{height}" for width, height in SIZES]
    return subprocess.run([sys.executable, "-c", RUN, *sizes], cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("width, height", SIZES)
def test_a_size_ends_well(done, width, height):
    assert f"refined {width}x{height}\n" in done.stdout, f"ended with {done.returncode}: {done.stderr[-2000:]}"


def test_the_process_ends_well(done):
    assert done.returncode == 0, f"ended with {done.returncode}: {done.stderr[-2000:]}"
