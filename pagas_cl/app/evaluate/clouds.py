"""Distances between point clouds: Chamfer figures as DTU defines them, F-score as Tanks and Temples does.

A mesh becomes a cloud of points that are spread evenly over its area, the same ones every time.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import default_rng

from pagas_cl.errors import InputError, need
from pagas_cl.scene.check.patches import area_of, spread_over
from pagas_cl.scene.meshes.files import FORMATS, read_content
from pagas_cl.scene.npy_files import read_first, read_npy
from pagas_cl.system.files import translated

_MOST = 50_000_000


@dataclass(frozen=True)
class Chamfer:
    """Distances from the result to the truth (accuracy) and back (completeness), scene units; `overall`: their mean."""

    accuracy: float
    completeness: float
    overall: float
    accuracy_median: float
    completeness_median: float
    result_points: int
    truth_points: int


@dataclass(frozen=True)
class FScore:
    """Shares, 0 to 1, of points within `threshold` (scene units) of the other cloud."""

    precision: float
    recall: float
    f_score: float
    threshold: float


@dataclass(frozen=True, eq=False)
class VisibleSpace:
    """What a benchmark's scanner could see: only there is a result judged. Lengths in scene units.

    `seen` is bool (X, Y, Z), voxel (i, j, k) centred at corner + voxel * (i, j, k); `corner` to `far_corner` is the box
    that DTU calls BB: points further than `margin` outside are not looked at.
    """

    seen: np.ndarray
    corner: np.ndarray
    far_corner: np.ndarray
    voxel: float
    margin: float = 60.0

    def in_box(self, points) -> np.ndarray:
        """Which points lie in the widened box: bool (n,). DTU widens the far side twice."""
        return ((points >= self.corner - self.margin) & (points < self.far_corner + 2 * self.margin)).all(axis=1)

    def contains(self, points) -> np.ndarray:
        """Which points lie in a seen voxel: bool (n,)."""
        index = np.rint((points - self.corner) / self.voxel).astype(np.int64)
        inside = ((index >= 0) & (index < self.seen.shape)).all(axis=1)
        out = np.zeros(len(points), bool)
        out[inside] = self.seen[tuple(index[inside].T)]
        return out


def chamfer(result, truth, *, downsample=None, max_distance=np.inf, visible: VisibleSpace | None = None,
            ground=None, surfaces=(None, None)) -> Chamfer:
    """Chamfer distances between two clouds (n, 3); for meshes see `sample_surface`.

    DTU's own figures: `downsample` 0.2 mm, `max_distance` 20 mm, its ObsMask as `visible`, its Plane as `ground`.

    The result is thinned so that no two points are nearer than `downsample`; distances above `max_distance` are left
    out of the means (they are outliers to DTU); result points outside `visible` do not count as wrong; of a `ground`
    (a, b, c, d) only truth points with a x + b y + c z + d > 0 have to be found. `surfaces`: the mesh ((V, 3) vertices,
    (F, 3) faces), or None, that the result, and the truth, is a cloud of: distances are to its surface then; those to a
    cloud have a floor, see `floor_of`.
    """
    result, truth = _cloud(result, "result"), _cloud(truth, "truth")
    if downsample:
        result = result[thin(result, downsample)]
    judged = result
    if visible is not None:
        result = result[visible.in_box(result)]
        judged = result[visible.contains(result)]
    wanted = truth
    if not max_distance > 0:
        raise InputError(f"Chamfer distance: the largest distance is {max_distance:g}, expected more than 0")
    if ground is not None:
        plane = np.asarray(ground, np.float64).ravel()
        if plane.shape != (4,):
            raise InputError(f"ground plane has {plane.size} numbers, expected 4: a, b, c, d of a x + b y + c z + d")
        wanted = truth[truth @ plane[:3] + plane[3] > 0]
    for name, cloud in (("result inside the visible space", judged), ("truth above the ground plane", wanted)):
        if not len(cloud):
            raise InputError(f"Chamfer distance: no point of the {name} is left; are both in the same frame and unit?")
    of_result, of_truth = surfaces
    distances = [d[d < max_distance] for d in (nearest(judged, truth, of_truth), nearest(wanted, result, of_result))]
    for name, kept in zip(("result", "truth"), distances):
        if not len(kept):
            raise InputError(f"Chamfer distance: no point of the {name} lies within {max_distance:g} of the other "
                             "cloud; are both in the same frame and unit? Else give a larger distance")
    means, medians = ([float(f(d)) for d in distances] for f in (np.mean, np.median))
    return Chamfer(*means, sum(means) / 2, *medians, len(judged), len(wanted))


def f_score(result, truth, threshold: float, *, downsample=None, surfaces=(None, None)) -> FScore:
    """Precision, recall, F-score; Tanks and Temples has `downsample=threshold / 2`; `surfaces` as in chamfer."""
    if not threshold > 0:
        raise InputError(f"F-score: the threshold is {threshold!r}, expected a length above 0 in scene units")
    result, truth = _cloud(result, "result"), _cloud(truth, "truth")
    if downsample:
        result, truth = (cloud[thin(cloud, downsample)] for cloud in (result, truth))
    precision = float((nearest(result, truth, surfaces[1]) < threshold).mean())
    recall = float((nearest(truth, result, surfaces[0]) < threshold).mean())
    both = precision + recall
    return FScore(precision, recall, 2 * precision * recall / both if both else 0.0, float(threshold))


def nearest(points, cloud, surface=None) -> np.ndarray:
    """Distance of `points` (n, 3) from the nearest of `cloud` (m, 3), or of a `surface` (vertices, faces), to float32
    of its extent: float64 (n,)."""
    if surface is None:
        return _tree(cloud).query(points, workers=-1)[0]
    o3d = need("open3d", "mesh", "distances to a surface")
    vertices, faces = (np.asarray(part) for part in surface)
    middle = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(vertices - middle, np.float32), np.ascontiguousarray(faces, np.uint32))
    return scene.compute_distance(np.ascontiguousarray(points - middle, np.float32)).numpy().astype(np.float64)


def floor_of(cloud) -> float:
    """What distances to a cloud (n, 3) are at least, on the average, where the surfaces are the same: half of the mean
    distance from a point to its nearest neighbour, scene units. 0 for a single point."""
    return float(_tree(cloud).query(cloud, k=2, workers=-1)[0][:, 1].mean() / 2) if len(cloud) > 1 else 0.0


def thin(points, radius: float) -> np.ndarray:
    """Keep points in a random but repeatable order, dropping each within `radius` of one kept before: bool (n,).

    As DTU's evaluation does in a loop, in rounds: a point whose earlier neighbours are all dropped is kept.
    """
    if not radius > 0:
        raise InputError(f"thinning: the radius is {radius!r}, expected a length above 0 in scene units")
    rank = default_rng(0).permutation(len(points))
    pairs = _tree(points).query_pairs(radius, output_type="ndarray")
    earlier = np.where(rank[pairs[:, 0]] < rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    later = pairs.sum(axis=1) - earlier
    kept, undecided = np.zeros(len(points), bool), np.ones(len(points), bool)
    while undecided.any():
        waits = np.zeros(len(points), bool)
        waits[later] = True
        kept |= undecided & ~waits
        undecided &= waits
        undecided[later[kept[earlier]]] = False
        open_pairs = undecided[earlier] & undecided[later]
        earlier, later = earlier[open_pairs], later[open_pairs]
    return kept


def _tree(points):
    need("scipy", "evaluate", "comparing point clouds")
    from scipy.spatial import cKDTree

    return cKDTree(points)


def _cloud(points, who):
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{who} cloud has shape {points.shape}, expected (n, 3)")
    if not len(points):
        raise InputError(f"{who} cloud is empty")
    if not np.isfinite(points).all():
        raise InputError(f"{who} cloud holds coordinates that are not finite; drop those points first")
    return points


def load_visible(path) -> VisibleSpace:
    """Read DTU's ObsMask<scan>_10.mat: ObsMask (bool grid), BB (two corners, mm), Res (voxel, mm)."""
    data = _load_mat(path, "ObsMask", "BB", "Res")
    box = np.asarray(data["BB"], np.float64).reshape(2, 3)
    return VisibleSpace(np.asarray(data["ObsMask"], bool), box[0], box[1], float(np.ravel(data["Res"])[0]))


def load_ground(path) -> np.ndarray:
    """Read DTU's Plane<scan>.mat, the table that its objects stand on: P, float64 of shape (4,)."""
    return np.asarray(_load_mat(path, "P")["P"], np.float64).ravel()


def _load_mat(path, *names):
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {str(path)!r}")
    need("scipy", "evaluate", "reading DTU's .mat files")
    from scipy.io import loadmat

    with translated(f"{str(path)!r} is no MATLAB file that SciPy reads: ", damage=(ValueError, NotImplementedError)):
        data = loadmat(path)
    missing = [name for name in names if name not in data]
    if missing:
        raise InputError(f"{str(path)!r} has no variable {missing[0]!r}, expected {', '.join(names)}")
    return data


def sample_surface(vertices, faces, spacing: float) -> np.ndarray:
    """One point for each spacing**2 (scene units) of area of a mesh, (V, 3) and int (F, 3): float64 (n, 3)."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    area = area_of(vertices, faces)
    if not area > 0:
        raise InputError("the mesh has no area, so no points can be taken from it")
    if not spacing > 0:
        raise InputError(f"sampling: the spacing is {spacing!r}, expected a length above 0 in scene units")
    number = max(1, round(area / spacing**2))
    if number > _MOST:
        raise InputError(f"sampling a mesh of area {area:.6g} every {spacing:g} gives {number} points, at most "
                         f"{_MOST} are taken; use a spacing of at least {np.sqrt(area / _MOST):.3g}")
    return spread_over(vertices, faces, number)[0]


def extent(points) -> float:
    """Diagonal of the bounding box, scene units."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def read_shape(path) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertices and faces of a mesh's file, or points (n, 3), float64, and None.

    .npy, .npz (first array), .xyz, .txt (x y z first on a line); else as read_mesh: a mesh where there are triangles.
    """
    path, faces = Path(path), None
    if not path.is_file():
        raise InputError(f"{str(path)!r} is a folder, expected the file of a mesh or of points" if path.is_dir()
                         else f"there is no file {str(path)!r}")
    suffix = path.suffix.lower()
    with translated(f"{str(path)!r} is no list of points, expected (n, 3): "):
        if suffix in (".npy", ".npz"):
            points = (read_first if suffix == ".npz" else read_npy)(path)
        elif suffix in (".xyz", ".txt"):
            points = np.loadtxt(path, dtype=np.float64, usecols=(0, 1, 2), ndmin=2)
        elif suffix in FORMATS:
            content = read_content(path)
            points, faces = content.vertices, content.faces if len(content.faces) else None
        else:
            raise InputError(f"{str(path)!r}: unknown kind {path.suffix!r}, expected a mesh or points as one of "
                             f"{', '.join((*FORMATS, '.npy', '.npz', '.xyz', '.txt'))}")
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(f"{str(path)!r} holds points of shape {points.shape}, expected (n, 3) with n of at least 1")
    return points, faces
