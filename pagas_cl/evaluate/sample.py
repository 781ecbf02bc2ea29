"""Points from meshes and files: a mesh is sampled evenly by area, the same way every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, need

_R2 = np.array([0.7548776662466927, 0.5698402909980532])  # Roberts' low-discrepancy sequence in the plane
_MOST = 50_000_000


def sample_surface(vertices, faces, spacing: float) -> np.ndarray:
    """One point for each spacing**2 (scene units) of area of a mesh, (V, 3) and int (F, 3): float64 (n, 3)."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    total = np.cumsum(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if not len(total) or not total[-1] > 0:
        raise InputError("the mesh has no area, so no points can be taken from it")
    if not spacing > 0:
        raise InputError(f"sampling: the spacing is {spacing!r}, expected a length above 0 in scene units")
    number = max(1, round(total[-1] / spacing**2))
    if number > _MOST:
        raise InputError(f"sampling a mesh of area {total[-1]:.6g} every {spacing:g} gives {number} points, at most "
                         f"{_MOST} are taken; use a spacing of at least {np.sqrt(total[-1] / _MOST):.3g}")
    at = (np.arange(number) + 0.5) / number * total[-1]
    face = np.minimum(np.searchsorted(total, at, side="right"), len(faces) - 1)
    u, v = np.modf(np.arange(1, number + 1)[:, None] * _R2)[0].T
    flip = u + v > 1  # the parallelogram's far half, folded back
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]


def load_points(source, spacing: float | None = None) -> np.ndarray:
    """Points (n, 3) of what `read_shape` takes: of a mesh every `spacing` (None: its extent / 1000), or a cloud's."""
    points, faces = read_shape(source)
    return points if faces is None else sample_surface(points, faces, spacing or extent(points) / 1000)


def extent(points) -> float:
    """Diagonal of the bounding box, scene units."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def read_shape(source):
    """Vertices and faces of a mesh, or points (n, 3) and None, from a path, an array, a pair or a mesh object.

    Files: .npy, .npz (first array), .xyz, .txt (x y z first on a line); else what Open3D reads (.ply, .obj, ...);
    a file with triangles is a mesh, else a point cloud.
    """
    if isinstance(source, (str, Path)):
        points, faces = _read(Path(source))
    elif isinstance(source, np.ndarray):
        points, faces = source, None
    elif isinstance(source, tuple) and len(source) == 2:
        points, faces = source
    else:
        from pagas_cl.scene.mesh import to_surface

        surface = to_surface(source)
        points, faces = surface.vertices, surface.faces
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(f"points have shape {points.shape}, expected (n, 3) with n of at least 1")
    return points, faces


def _read(path):
    if not path.is_file():
        raise InputError(f"there is no file {str(path)!r}")
    suffix = path.suffix.lower()
    try:
        if suffix in (".npy", ".npz"):
            data = np.load(path, allow_pickle=False)
            return (data[data.files[0]] if suffix == ".npz" else data), None
        if suffix in (".xyz", ".txt"):
            return np.loadtxt(path, dtype=np.float64, usecols=(0, 1, 2), ndmin=2), None
    except (ValueError, IndexError, OSError) as error:
        raise InputError(f"{str(path)!r} is no list of points, expected (n, 3): {error}") from error
    o3d = need("open3d", "mesh", f"reading {path.name}")
    mesh = o3d.io.read_triangle_mesh(str(path))
    if len(mesh.triangles):
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    cloud = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    if not len(cloud):
        raise InputError(f"{str(path)!r} holds neither triangles nor points that Open3D can read")
    return cloud, None
