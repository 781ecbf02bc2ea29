"""Which blocks of the grid each view touches, kept on disk: the plan of a fusion in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError, need
from pagas_cl.scene.view import View
from pagas_cl.surface import fuse as whole
from pagas_cl.surface.fuse import FusionPlan
from pagas_cl.surface.grid import Grid, block_resolution

_AT_A_TIME = 1 << 21  # keys that are collected before doubles are dropped


class BlockFiles(Sequence):
    """Blocks of each view, int32 of shape (N, 3), read when they are asked for."""

    def __init__(self, folder: Path, count: int):
        self.folder, self._count = folder, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> np.ndarray:
        return np.load(self.folder / f"blocks{index:06d}.npy")

    def put(self, index: int, blocks: np.ndarray) -> None:
        np.save(self.folder / f"blocks{index:06d}.npy", blocks)


@dataclass(frozen=True, eq=False)
class Touched:
    """The plan of a fusion, and all different blocks of it: int32 of shape (N, 3)."""

    plan: FusionPlan
    blocks: np.ndarray


def touched_by_views(views, depths, settings: Fusion, folder: Path) -> Touched:
    """As surface.fuse.fusion_plan, with the blocks of each view in files below `folder`."""
    o3d = need("open3d", "mesh", "fusing depth maps to a mesh")
    cameras = [view.camera if isinstance(view, View) else view for view in views]
    if len(cameras) != len(depths):
        raise InputError(f"there are {len(cameras)} views and {len(depths)} depth maps, expected one each")
    footprint, grid_scale, middle, low, high = whole._measured(cameras, depths)
    voxel = settings.voxel * footprint
    grid = Grid(voxel / grid_scale, settings.truncation, 1, 2 * high / grid_scale, False, o3d)
    files, union = BlockFiles(folder, len(cameras)), _Union()
    for index, (camera, depth) in enumerate(zip(cameras, depths)):
        depth = whole._depth(camera, depth, whole._FAR * voxel, grid_scale)
        blocks = np.zeros((0, 3), np.int32)
        if depth is not None:
            wide = bool(depth.max() * grid_scale / camera.fx > 2 * voxel)
            blocks = grid.touched(depth, whole._intrinsics(camera), whole._pose(camera, middle, grid_scale), every=wide)
        files.put(index, blocks)
        union.add(blocks)
    blocks = union.blocks()
    edge = block_resolution(settings.truncation)
    vertices = len(blocks) * edge**2 * whole._VERTICES
    memory = max(len(blocks) * edge**3 * whole._VOXEL_BYTES + vertices * whole._VERTEX_BYTES,
                 vertices * whole._AFTER_BYTES) / 1e6
    plan = FusionPlan(voxel, settings.truncation * voxel, (low, high), files, len(blocks), memory, middle, grid_scale)
    return Touched(plan, blocks)


class _Union:
    """Different blocks of many views; doubles are dropped now and then, so that memory follows the surface."""

    def __init__(self):
        self._keys, self._waiting, self._held = np.zeros(0, np.int64), [], 0

    def add(self, blocks: np.ndarray) -> None:
        self._waiting.append(whole._keys(blocks))
        self._held += len(blocks)
        if self._held > max(_AT_A_TIME, len(self._keys) // 2):
            self._merge()

    def blocks(self) -> np.ndarray:
        self._merge()
        mask = (1 << 21) - 1
        parts = [((self._keys >> shift) & mask) - (1 << 20) for shift in (42, 21, 0)]
        return np.stack(parts, axis=1).astype(np.int32)

    def _merge(self) -> None:
        self._keys = np.unique(np.concatenate([self._keys, *self._waiting]))
        self._waiting, self._held = [], 0
