"""Which pixel-centre convention this Open3D has, measured rather than believed (Open3D#7580 may change it)."""

from __future__ import annotations

import logging
from functools import lru_cache

import numpy as np

from pagas_cl.errors import PagasError

log = logging.getLogger("pagas_cl")

_NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
_TILT = np.array([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]])  # a rotation: 0.28^2 + 0.96^2 = 1


@lru_cache(maxsize=1)
def grid_shift() -> float:
    """What must be added to cx and cy (of centres at +0.5) for VoxelBlockGrid: 0 where it agrees, -0.5 where it counts
    centres at whole numbers.

    A tilted plane is fused with either reading; half a pixel off leaves a signed error that the right reading does not
    have. Takes some 0.1 s, once a process.
    """
    error = {shift: _plane_error(shift) for shift in (0.0, -0.5)}
    best = min(error, key=lambda shift: abs(error[shift]))
    other = -0.5 - best
    if not abs(error[best]) < 0.2 * abs(error[other]):
        raise PagasError("this Open3D's VoxelBlockGrid puts a tilted plane neither at pixel centres +0.5 nor at whole "
                         f"numbers (errors {error[0.0]:.2g} and {error[-0.5]:.2g}); install open3d 0.19 or 0.20")
    if best:
        log.warning("this Open3D's VoxelBlockGrid counts pixel centres at whole numbers; cx and cy are shifted by %g",
                    best)
    return best


def _plane_error(shift: float) -> float:
    """Signed mean distance, in units of the distance half a pixel makes, of a fused plane from the true one."""
    import open3d as o3d

    from pagas_cl.surface.grid import Grid

    width, height, focal, cx, cy = 80, 60, 70.0, 43.3, 27.1
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _TILT, (0.1, -0.05, 2.0)
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / focal, (np.arange(height) + 0.5 - cy) / focal)
    center = -_TILT.T @ pose[:3, 3]
    slope = np.stack([x, y, np.ones_like(x)], -1) @ (_TILT @ _NORMAL)
    depth = (-np.dot(_NORMAL, center) / slope).astype(np.float32)
    K = np.array([[focal, 0, cx + shift], [0, focal, cy + shift], [0, 0, 1]])
    grid = Grid(voxel=0.04, truncation=4.0, blocks=200, depth_max=10.0, colour=False)
    grid.integrate(grid.touched(depth, K, pose), depth, None, K, pose)
    vertices = grid.extract(0.5)[0]
    if len(vertices) < 50:
        raise PagasError(f"this Open3D ({o3d.__version__}) fuses a plane to {len(vertices)} vertices; install open3d "
                         "0.19 or 0.20")
    return float((vertices @ _NORMAL).mean()) / (0.5 * 2.0 / focal)
