"""A few of many; of a depth map: its scale, and what planning needs, so that 10,000 of them fit in memory."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

SAMPLES = 2000  # depths of a view that planning looks at
NEAR, FAR = 1e-3, 1e6     # units: nearer and farther depths have no Gaussian
MEDIAN_SAMPLES = 8192


def evenly(count: int, most: int) -> npt.NDArray[np.intp]:
    """At most `most` of the numbers 0 to count - 1, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.intp))


@dataclass(frozen=True, eq=False)
class DepthSample:
    """Some depths of a view, and a coarse grid of its farthest ones (some 30 kB a view).

    `rows`, `columns` (int32) and `depth` (float32) are (N,): up to `SAMPLES` valid pixels, evenly spread. `farthest`
    (h, w): the largest depth in each cell of `cell` pixels a side, 0 where none is valid; `shape`: (height, width)
    of the depth map.
    """

    rows: np.ndarray = field(repr=False)
    columns: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    farthest: np.ndarray = field(repr=False)
    shape: tuple[int, int]
    cell: int


def sample_depth(depth: np.ndarray) -> DepthSample:
    """Cut a depth map (H, W) down."""
    rows, columns = sample_pixels(depth)
    size = -(-max(depth.shape) // 64)
    padded = np.zeros([-(-n // size) * size for n in depth.shape], np.float32)
    padded[:depth.shape[0], :depth.shape[1]] = depth
    height, width = padded.shape
    bands = padded.reshape(height // size, size, width).max(axis=1)     # an axis at a time: a fifth of the time
    return DepthSample(rows.astype(np.int32), columns.astype(np.int32), depth[rows, columns].astype(np.float32),
                       bands.reshape(len(bands), -1, size).max(axis=2), tuple(depth.shape), size)


def sample_pixels(depth: np.ndarray, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of up to `samples` valid (> 0) pixels, on a regular lattice as coarse as that allows."""
    step = max(1, int(np.sqrt(depth.size / samples)))
    while True:
        rows, columns = np.nonzero(depth[step // 2::step, step // 2::step] > 0)
        if len(rows) >= samples // 2 or step == 1:
            break
        step = max(1, step // 2)  # a small object in a large photo: look closer
    rows, columns = rows * step + step // 2, columns * step + step // 2
    finite = np.isfinite(depth[rows, columns])
    keep = slice(None, None, max(1, -(-np.count_nonzero(finite) // samples)))
    return rows[finite][keep], columns[finite][keep]


def scene_scale_of(depth: np.ndarray, mask: np.ndarray | None) -> float:
    """A view's unit of length while it is refined: the median of (a regular sample of) its valid depths; 1 without."""
    every = max(1, depth.size // MEDIAN_SAMPLES)
    sample = _valid_of(depth, mask, every)
    if every > 1 and sample.size < MEDIAN_SAMPLES // 16:        # a small object in a large photo
        sample = _valid_of(depth, mask, 1)
    if not sample.size:
        return 1.0
    middle = [(sample.size - 1) // 2, sample.size // 2]        # np.median, but for copies in another precision
    return float(np.partition(sample, middle)[middle].mean(dtype=np.float64))


def _valid_of(depth: np.ndarray, mask: np.ndarray | None, every: int) -> np.ndarray:
    some = np.ascontiguousarray(depth.ravel()[::every])
    valid = (some > 0) & (some < np.inf)
    if mask is not None:
        valid &= mask.ravel()[::every]
    return some if valid.all() else some[valid]
