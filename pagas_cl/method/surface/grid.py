"""Open3D's VoxelBlockGrid with nothing left to its defaults; its pixel-centre convention, measured (Open3D#7580)."""

from functools import lru_cache

import numpy as np

from pagas_cl.errors import PagasError, log, need
from pagas_cl.scene.camera import rigid

_STRIDE = 4      # Open3D looks at every fourth pixel of every fourth row when it touches blocks (measured)
# One look in each row and column of a 4 x 4 cell, so that a line one pixel wide is touched too.
_FEW = ((0, 1), (1, 3), (2, 0), (3, 2))
_REACH = 10.0    # Open3D looks at 4 depths across the truncation band: blocks must not fit between two of them
_ROOM = 10       # a tenth of the blocks is spare room, see Grid.integrate
_ALL = tuple((r, c) for r in range(_STRIDE) for c in range(_STRIDE))
_KEYS_HELD = 1 << 21     # keys of blocks that are collected before doubles are dropped
_NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
_TILT = np.array([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]])  # a rotation: 0.28^2 + 0.96^2 = 1


def block_resolution(truncation: float) -> int:
    """Voxels along the edge of a block. Small blocks hug the surface: 8 takes 0.65 of the memory and time of 16."""
    resolution = 8
    while truncation > _REACH * resolution / 8:
        resolution *= 2
    return resolution


class Grid:
    """A sparse TSDF with room for so many blocks, with colours or without. `voxel` is a voxel's edge and `depth_max`
    above every depth that will come, both in the grid's own unit; `truncation` is in voxels."""

    def __init__(self, voxel: float, truncation: float, blocks: int, depth_max: float, colour: bool):
        open3d = need("open3d", "mesh", "fusing depth maps to a mesh")
        self._o3c, self._geometry = open3d.core, open3d.t.geometry
        names, channels = ("tsdf", "weight", "color"), ((1), (1), (3))
        used = 3 if colour else 2
        self._room = max(64, int(blocks) // _ROOM)
        self._grid = self._geometry.VoxelBlockGrid(
            attr_names=names[:used], attr_dtypes=(self._o3c.float32,) * used, attr_channels=channels[:used],
            voxel_size=float(voxel), block_resolution=block_resolution(truncation),
            block_count=int(blocks) + self._room, device=self._o3c.Device("CPU:0"))
        self._range = (1.0, float(depth_max), float(truncation))

    def touched(self, depth: np.ndarray, K: np.ndarray, pose: np.ndarray, *, every: bool = False) -> np.ndarray:
        """Blocks within the truncation distance: int32 (N, 3). `every` pixel, where one is wider than a voxel."""
        found = []
        for row, column in _ALL if every else _FEW:
            part = depth[row:, column:]
            if not (part[::_STRIDE, ::_STRIDE] > 0).any():
                continue  # Open3D raises "No block is touched"
            rows, columns = (size // _STRIDE * _STRIDE for size in part.shape)
            if not (part[:rows:_STRIDE, :columns:_STRIDE] > 0).any():     # so it does here: it looks at whole cells
                part = np.pad(part, [(0, -size % _STRIDE) for size in part.shape])
            moved = K.copy()
            moved[:2, 2] -= (column, row)
            blocks = self._grid.compute_unique_block_coordinates(
                self._image(part[..., None]), self._o3c.Tensor(moved), self._o3c.Tensor(np.array(pose)), *self._range)
            found.append(blocks.numpy())
        return np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 3), np.int32)

    def integrate(self, blocks: np.ndarray, depth: np.ndarray, colour: np.ndarray | None, K: np.ndarray,
                  pose: np.ndarray) -> None:
        """Add one depth map (H, W) float32, with colours (H, W, 3) float32 from 0 to 1: by parts, since Open3D doubles
        its table when the blocks it has and those that come, old or new, exceed it together (measured)."""
        K, pose = self._o3c.Tensor(K), self._o3c.Tensor(np.array(pose))
        images = [self._image(image) for image in (depth[..., None], colour) if image is not None]
        for start in range(0, len(blocks), self._room):
            part = self._o3c.Tensor(np.ascontiguousarray(blocks[start:start + self._room]))
            self._grid.integrate(part, *images, *[K] * len(images), pose, *self._range)

    def extract(self, threshold: float):
        """Vertices (V, 3), faces (F, 3), normals (V, 3), colours (V, 3) or None, of voxels of weight above `threshold`;
        empty arrays where there is no surface."""
        mesh = None
        if self._grid.hashmap().size():
            mesh = self._grid.extract_triangle_mesh(weight_threshold=float(threshold))
        if mesh is None or "positions" not in mesh.vertex or "indices" not in mesh.triangle:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)), None
        return (mesh.vertex["positions"].numpy(), mesh.triangle["indices"].numpy(), mesh.vertex["normals"].numpy(),
                mesh.vertex["colors"].numpy() if "colors" in mesh.vertex else None)

    def seen(self, most: int = 4) -> np.ndarray:
        """How many voxels hold weight 1, 2, ... `most` and more: int64 of shape (most,)."""
        weight = self._grid.attribute("weight").numpy().reshape(-1)
        count = np.zeros(most + 1, np.int64)
        for start in range(0, len(weight), 1 << 24):
            part = np.clip(np.rint(weight[start:start + (1 << 24)]), 0, most).astype(np.int64)
            count += np.bincount(part, minlength=most + 1)
        return count[1:]

    def _image(self, pixels: np.ndarray):
        return self._geometry.Image(self._o3c.Tensor(np.ascontiguousarray(pixels, np.float32)))


@lru_cache(maxsize=1)
def grid_shift() -> float:
    """What must be added to cx and cy (of centres at +0.5) for VoxelBlockGrid: 0 where it agrees, -0.5 where it counts
    centres at whole numbers. A tilted plane is fused with either reading; half a pixel off leaves a signed error that
    the right one does not have. Takes some 0.1 s, once a process."""
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

    width, height, focal, cx, cy = 80, 60, 70.0, 43.3, 27.1
    pose = rigid(_TILT, (0.1, -0.05, 2.0))
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


class Union:
    """Different blocks of many views; doubles are dropped now and then, so that memory follows the surface."""

    def __init__(self):
        self._keys, self._waiting, self._held = np.zeros(0, np.int64), [], 0

    def add(self, blocks: np.ndarray) -> None:
        part = blocks.astype(np.int64) + (1 << 20)
        self._waiting.append((part[:, 0] << 42) | (part[:, 1] << 21) | part[:, 2])
        self._held += len(blocks)
        if self._held > max(_KEYS_HELD, len(self._keys) // 2):
            self._merge()

    def blocks(self) -> np.ndarray:
        self._merge()
        parts = [((self._keys >> shift) & ((1 << 21) - 1)) - (1 << 20) for shift in (42, 21, 0)]
        return np.stack(parts, axis=1).astype(np.int32)

    def _merge(self) -> None:
        self._keys = np.unique(np.concatenate([self._keys, *self._waiting]))
        self._waiting, self._held = [], 0
