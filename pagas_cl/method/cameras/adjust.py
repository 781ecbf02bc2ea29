"""Launches of adjust.cl: what the pixels of a target say of cameras, without their depths (method section 9)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import pyopencl as cl

from pagas_cl.method.cameras.normalize import smooth
from pagas_cl.method.splat.constants import define
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Camera, Size, camera_table
from pagas_cl.scene.sampling import NEAR

HUBER, CUT = 0.3, 2.5     # residuals beyond the first count linearly, beyond the second not at all
BORDER = 5.0              # pixels along a photo's edges that are not used: its windows are cut there
CHUNK, COST_CHUNK = 256, 64      # pixels that one work-item adds up
DEFINES = define(NEAR=NEAR, HUBER=HUBER, CUT=CUT, BORDER=BORDER, CHUNK=CHUNK, COST_CHUNK=COST_CHUNK)
SMOOTHED = 1.5            # pixels over which steps of depths are averaged
PRIOR = 1e-3              # of the residual, a squared pixel of parallax: holds depths that no photo fixes


@dataclass(frozen=True, eq=False)
class Frame:
    """A view on the device at one size: its camera there, the normalised photo and the depth, float32 (H, W)."""

    camera: Camera
    normal: cl.Buffer
    depth: cl.Buffer

    @property
    def size(self) -> Size:
        return self.camera.size

    def release(self) -> None:
        release(self.normal, self.depth)


@dataclass(frozen=True)
class Block:
    """What the pixels of a target say of its context views' cameras, as seen from it: the depths are eliminated.
    `matrix` (K, C, K, C) and `right` (K, C) float64: the normal equations matrix x = -right, by the C numbers of each
    of K context views. `used`: pixels, (K,); `squares`: sum of their squared weighted residuals, (K,)."""

    matrix: np.ndarray
    right: np.ndarray
    used: np.ndarray
    squares: np.ndarray


class Adjuster:
    """The kernels on one device; lengths of depths and cameras in units of `scene_scale` scene units."""

    def __init__(self, device, scene_scale: float, intrinsics: bool = False):
        self.device, self.scene_scale, self.intrinsics = device, scene_scale, intrinsics
        self.columns, self._row = (14, 16) if intrinsics else (6, 8)
        self.program = build(device, "adjust.cl", (*DEFINES, *(["INTRINSICS"] if intrinsics else [])))

    def block(self, target: Frame, others: Sequence[Frame], prior: float, tolerance: float, limit: float = 0.0,
              sums: bool = True) -> Block | None:
        """The Block of a target (None without `sums`). With `limit` its depths then make their own step, at most
        `limit` (of a depth of 1). `prior`: as eliminate has it; infinite leaves depths as they are. `tolerance`: share
        of the depth by which an other view's own depth may differ where it sees the same point."""
        size, views = target.size, len(others)
        rows = self.device.buffer(4 * self._row * views * size.pixels, "rows")
        steps, cameras = self.device.buffer(8 * size.pixels, "steps"), self._table(target, others)
        given = {"normal": target.normal, "depth": target.depth, "cameras": cameras, "rows": rows, **size.extent}
        for view, other in enumerate(others, 1):
            self.program.run("linearize", size, view=view, other_normal=other.normal, other_depth=other.depth,
                             tolerance=tolerance, **given)
        self.program.run("eliminate", size, rows=rows, depth=target.depth, views=views, prior=prior, steps=steps,
                         **size.extent)
        chunks, entries = -(-size.pixels // CHUNK), views * (views + 1) // 2 * self.columns if sums else 0
        partial, total = (self.device.buffer(max(4, 4 * self._row * entries * n), "partial") for n in (chunks, 2))
        if sums:
            self.program.run("sum_pairs", (entries, chunks), rows=rows, steps=steps, views=views, count=size.pixels,
                             chunks=chunks, partial=partial)
            self.program.run("sum_chunks", (entries * self._row,), partial=partial, entries=entries * self._row,
                             chunks=chunks, sums=total)
        if limit > 0:
            smooth(self.device, steps, size, SMOOTHED)
            self.program.run("move_depth", size, steps=steps, limit=limit, depth=target.depth, **size.extent)
        found = download(self.device, total, (entries, self._row, 2)).astype(np.float64).sum(axis=-1) if sums else None
        release(rows, steps, cameras, partial, total)
        return None if found is None else self._block(found, views)

    def costs(self, target: Frame, others: Sequence[Frame], tolerance: float) -> np.ndarray:
        """Robust cost of the residuals and number of pixels seen, summed over the target, float64 (K, 2)."""
        size, cameras = target.size, self._table(target, others)
        chunks, out = -(-size.pixels // COST_CHUNK), []
        for view, other in enumerate(others, 1):
            costs = self.device.buffer(8 * chunks, "costs")
            self.program.run("pair_cost", (chunks,), normal=target.normal, depth=target.depth, cameras=cameras,
                             view=view, other_normal=other.normal, other_depth=other.depth, tolerance=tolerance,
                             width=size.width, count=size.pixels, chunks=chunks, costs=costs)
            out.append(download(self.device, costs, (chunks, 2)).astype(np.float64).sum(axis=0))
            costs.release()
        cameras.release()
        return np.array(out).reshape(-1, 2)

    def copied(self, frame: Frame) -> Frame:
        """The same with depths of its own."""
        depth = self.device.buffer(4 * frame.size.pixels, "initial")
        cl.enqueue_copy(self.device.queue, depth, frame.depth)
        return replace(frame, depth=depth)

    def read(self, frame: Frame, buffer: cl.Buffer) -> np.ndarray:
        """A buffer of a frame, or like those that it has, (H, W)."""
        return download(self.device, buffer, frame.size.shape)

    def carry(self, coarse: Frame, coarse_initial: cl.Buffer, fine: Frame) -> None:
        """Multiply the depths of `fine` by what those of `coarse` were changed by."""
        self.program.run("carry_depth", fine.size, coarse=coarse.depth, coarse_initial=coarse_initial,
                         source_width=coarse.size.width, source_height=coarse.size.height, depth=fine.depth,
                         **fine.size.extent)

    def rescale(self, frame: Frame, scale: float, shift: float) -> None:
        self.program.run("rescale_depth", frame.size, scale=scale, shift=shift, depth=frame.depth, **frame.size.extent)

    def _table(self, target: Frame, others: Sequence[Frame]) -> cl.Buffer:
        return upload(self.device, camera_table(target.camera, [other.camera for other in others], self.scene_scale))

    def _block(self, found: np.ndarray, views: int) -> Block:
        """From the sums, (entries, ROW): pairs of views with the first not behind the second, by rows."""
        lanes = [*range(6), *range(8, self._row)]
        found = found.reshape(-1, self.columns, self._row)
        matrix, right = np.zeros((views, self.columns, views, self.columns)), np.zeros((views, self.columns))
        used, squares = np.zeros(views), np.zeros(views)
        pairs = [(one, two) for one in range(views) for two in range(one, views)]
        for (one, two), sums in zip(pairs, found):
            matrix[one, :, two] = sums[:, lanes]
            matrix[two, :, one] = sums[:, lanes].T
            if one == two:
                right[one], used[one], squares[one] = sums[:, 6], sums[0, 7], sums[1, 7]
        return Block(matrix, right, used, squares)


@dataclass(frozen=True)
class Wanted:
    """What is to be computed of a target: places of it and of its context views, and Adjuster.block's arguments."""

    target: int
    others: tuple[int, ...]
    prior: float
    tolerance: float
    limit: float
    sums: bool = True


def blocks(adjuster: Adjuster, frames: Mapping[int, Frame] | Sequence[Frame],
           wanted: Sequence[Wanted]) -> list[Block | None]:
    """The Block of each target; all depths then make their steps, each as if no other had moved."""
    still = {one.target: adjuster.copied(frames[one.target]) for one in wanted}
    found = [adjuster.block(frames[one.target], [still.get(k, frames[k]) for k in one.others], one.prior, one.tolerance,
                            one.limit, one.sums) for one in wanted]
    release(*(frame.depth for frame in still.values()))
    return found


MakeBlocks: TypeAlias = Callable[[Adjuster, Sequence[Frame], Sequence[Wanted]], list[Block | None]]
"""`blocks`, or what does the same by other processes."""
