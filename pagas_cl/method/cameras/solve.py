"""The small system of all cameras, float64: put together from blocks, held where nothing is seen (method section 9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pagas_cl.errors import need
from pagas_cl.method.cameras.adjust import Block
from pagas_cl.method.cameras.motion import adjoint
from pagas_cl.scene.camera import Camera

DENSE = 200               # cameras up to which the system is solved by eigenvalues
CLOSEST, FARTHEST = 1e-4, 300.0      # pixels that cameras may be thought to be off by
_ROUNDS = 30              # of finding how far they are off


@dataclass(frozen=True)
class Term:
    """What one target says: its number, those of its context views, and the Block."""

    target: int
    others: tuple[int, ...]
    block: Block


@dataclass(frozen=True)
class Unknowns:
    """What is looked for besides the poses. `lenses`: for each view the number of the camera that it was taken with, of
    which focal length and principal point are unknown (empty: they are known). `depth`: 0, 1 or 2 numbers of each
    view's depth map, scale and shift. `scales`: pixels that a photo moves by for each unknown being 1, in their order:
    six of each pose, three of each lens, those of each depth map."""

    views: int
    scales: np.ndarray
    lenses: tuple[int, ...] = ()
    lens_numbers: tuple[int, ...] = ()
    depth: int = 0

    def pose(self, view: int) -> np.ndarray:
        return np.arange(6 * view, 6 * view + 6)

    def lens(self, view: int) -> np.ndarray:
        return 6 * self.views + 3 * self.lenses[view] + np.array(self.lens_numbers)

    def map(self, view: int) -> np.ndarray:
        first = len(self.scales) - self.depth * (self.views - view)
        return np.arange(first, first + self.depth)


def pixel_scales(cameras: Sequence[Camera], depths: Sequence[float]) -> np.ndarray:
    """About how many pixels a photo moves by for each number of a camera's twist being 1, (6 N,); `depths` in units."""
    rows = []
    for camera, depth in zip(cameras, depths):
        focal = 0.5 * (camera.fx + camera.fy)
        radius = 0.3 * np.hypot(camera.width, camera.height)      # of a usual pixel, from the middle
        rows.append([focal, focal, radius, focal / depth, focal / depth, radius / depth])
    return np.array(rows).ravel()


def projection(term: Term, cameras: Sequence[Camera], scene_scale: float,
               unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Places of the unknowns that a block depends on, and what each is in the block's numbers: (C K, places)."""
    views, columns = len(term.others), term.block.right.shape[1]
    places: list[np.ndarray] = []
    parts: list[np.ndarray] = []

    def part_of(where: np.ndarray) -> np.ndarray:
        places.append(where)
        parts.append(np.zeros((views, columns, len(where))))
        return parts[-1]

    of_target = part_of(unknowns.pose(term.target))
    for k, other in enumerate(term.others):
        rotation, tau = cameras[other].relative_to(cameras[term.target])
        of_target[k, :6] = -adjoint(rotation, tau / scene_scale)
        part_of(unknowns.pose(other))[k, :6] = np.eye(6)
    if unknowns.lenses:
        numbers = np.array(unknowns.lens_numbers)
        for first, which in ((9, [term.target] * views), (6, term.others)):      # places 6 to 8: of the context camera
            for k, view in enumerate(which):
                part_of(unknowns.lens(view))[k, first + numbers] = np.eye(len(numbers))
    if unknowns.depth:
        part_of(unknowns.map(term.target))[:, 12:12 + unknowns.depth] = np.eye(unknowns.depth)
    return np.concatenate(places), np.concatenate(parts, axis=2).reshape(views * columns, -1)


def assemble(terms: Sequence[Term], cameras: Sequence[Camera], scene_scale: float, unknowns: Unknowns):
    """The system and its right side, unknowns in pixels: dense, SciPy's sparse matrix beyond DENSE cameras.
    MissingExtraError where SciPy is needed and is not there."""
    size = len(unknowns.scales)
    right = np.zeros(size)
    dense = np.zeros((size, size)) if unknowns.views <= DENSE else None
    triples: list[tuple[np.ndarray, ...]] = []
    for term in terms:
        places, way = projection(term, cameras, scene_scale, unknowns)
        way = way / unknowns.scales[places]
        matrix = way.T @ term.block.matrix.reshape(len(way), len(way)) @ way
        np.add.at(right, places, way.T @ term.block.right.ravel())
        if dense is not None:
            np.add.at(dense, (places[:, None], places), 0.5 * (matrix + matrix.T))
        else:
            rows, columns = np.broadcast_arrays(places[:, None], places)
            triples.append(((matrix + matrix.T).ravel() / 2, rows.ravel(), columns.ravel()))
    if dense is not None:
        return dense, right
    need("scipy", "evaluate", f"refining more than {DENSE} cameras")
    from scipy.sparse import csc_matrix

    values, rows, columns = (np.concatenate(part) for part in zip(*triples))
    return csc_matrix((values, (rows, columns)), shape=(size, size)), right


def solve(system, right: np.ndarray, moved: np.ndarray, variance: float, spread: float,
          held: float = 0.0) -> tuple[np.ndarray, float]:
    """Where the unknowns go, pixels from where they were given, and how far they are off by that, typically.

    Minimises (y - moved)' S (y - moved) / 2 + right' (y - moved) + variance / spread^2 |y|^2 / 2. `variance` is that of
    a residual; `spread` is found with y, so that y is 0 where photos see nothing, and everywhere where they say no more
    than residuals alone would. `held`: how many unknowns the given `spread` counts for, more than
    those that photos determine: of a few cameras alone it is not to be found."""
    wanted, first = system @ moved - right, held * spread**2
    if isinstance(system, np.ndarray):
        values, vectors = np.linalg.eigh(system)
        values, wanted = np.maximum(values, 0.0), vectors.T @ wanted
        for _ in range(_ROUNDS):
            y = wanted / (values + variance / spread**2)
            determined = (values / (values + variance / spread**2)).sum()
            spread = float(np.clip(np.sqrt(((y**2).sum() + first) / max(determined + held, 1e-9)), CLOSEST, FARTHEST))
        return vectors @ (wanted / (values + variance / spread**2)), spread
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    for _ in range(3):
        y = splu((system + variance / spread**2 * identity(len(right))).tocsc()).solve(wanted)
        spread = float(np.clip(np.sqrt((y**2).mean()), CLOSEST, FARTHEST))
    return y, spread
