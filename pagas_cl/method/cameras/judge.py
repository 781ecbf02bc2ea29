"""A photo that judges, with a pose of its own fitted to the surface first: a held-out camera is off, too."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pagas_cl.errors import DeviceError, log
from pagas_cl.method.cameras.adjust import Adjuster
from pagas_cl.method.cameras.frames import Frames, depths_of, through
from pagas_cl.method.cameras.motion import moved, twist_between
from pagas_cl.method.cameras.rounds import FARTHEST_STEP, INFLATION, LOOSE, STILL, Stage
from pagas_cl.method.cameras.solve import pixel_scales, solve
from pagas_cl.method.splat import PhotoStore
from pagas_cl.runtime.device import open_device
from pagas_cl.runtime.memory import release
from pagas_cl.scene.view import View

_STAGES = (Stage(0.25, 4), Stage(0.5, 4), Stage(1.0, 8))
_SPREAD, _HELD = 1.0, 1.0      # pixels that a camera is off by, and how many of its six numbers that counts for
_SEEN = 1e6               # share of the depth: a view without a depth map sees everything


def fitted_poses(judge: View, target: View, depths: Sequence[np.ndarray]) -> list[View]:
    """`judge` once for each depth map of `target`, its pose fitted to it; as it is where there is no device."""
    try:
        return [fitted_pose(judge, target, depth) for depth in depths]
    except DeviceError as error:
        log.warning("held-out cameras are taken as they are: %s", error)
        return [judge] * len(depths)


def fitted_pose(judge: View, target: View, depth: np.ndarray, judge_depth: np.ndarray | None = None, device=None,
                photos: PhotoStore | None = None) -> View:
    """`judge` with the pose that fits its photo best to `target`'s through its `depth` (H, W), which stays.
    `judge_depth`: the judge's own depth map, by which points that are hidden there are left out. The same view where
    its photo does not see the surface."""
    device = open_device(device)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    if not depth.any():
        return judge
    scene_scale = float(np.median(depth[depth > 0]))
    shape = judge.camera.height, judge.camera.width
    own = np.full(shape, scene_scale, np.float32) if judge_depth is None else judge_depth
    adjuster = Adjuster(device, scene_scale)
    frames = Frames(adjuster, [target, judge], *depths_of([depth, own]), photos or PhotoStore(device))
    camera, tolerance = judge.camera, _SEEN if judge_depth is None else LOOSE
    for stage in _STAGES:
        pair = frames.at([target.camera, camera], stage.share)
        for _ in range(stage.rounds):
            block = adjuster.block(pair[0], pair[1:], np.inf, tolerance)
            if not block.used[0]:
                break
            scales = pixel_scales([pair[1].camera], [1.0])
            there = twist_between(judge.camera, camera, scene_scale) * scales
            y, _ = solve(block.matrix[0, :, 0] / scales[:, None] / scales, block.right[0] / scales, there,
                         INFLATION * float(block.squares[0] / block.used[0]), _SPREAD * stage.share, _HELD)
            step = y - there
            camera = moved(camera, step * min(1.0, FARTHEST_STEP / max(float(np.abs(step).max()), 1e-9)) / scales,
                           scene_scale)
            pair = through(pair, [target.camera, camera])
            if np.abs(step).max() < STILL:
                break
        release(*pair)
    return judge if camera is judge.camera else replace(judge, camera=camera)
