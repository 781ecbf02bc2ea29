"""Twin of cl_kernels/mesh_solve.cl: the same least squares, solved by SciPy in float64 (method section 10.3)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

LAMBDA, STAY, SEEN, CREASE, JUMP, LINKINGS, STILL, DETAIL = 3.0, 0.15, 0.01, 0.1, 0.5, 2, 0.02, 1.5
SHARP, LOOSE, FOLLOWS = 0.85, 0.01, 16


def displacements(vertices, faces, normals, flatness, reach, unit, seen, target, weight) -> np.ndarray:
    """Ways of the vertices, (V, 3) in scene units: along their normals, on creases with the planes that meet there."""
    middle, count = np.median(unit), len(vertices)
    scaled, each, t = vertices / middle, (middle / unit) ** 2, target / middle
    i, j = np.concatenate([faces[:, [k, m]] for k, m in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))]).T
    soft, crease = np.minimum(1, DETAIL * unit / reach) ** 2, flatness < SHARP
    delta = np.zeros(count)
    for _ in range(LINKINGS):
        bend = (1 - (normals[i] * normals[j]).sum(axis=1)) / CREASE
        length = np.maximum(np.linalg.norm(scaled[i] - scaled[j], axis=1), 0.3)
        steep = abs(delta[i] - delta[j]) / (length * JUMP)
        joined = np.where(crease[i] | crease[j], 0, 1 / ((1 + bend**2) * (1 + steep**2)))
        links = sparse.coo_matrix((joined, (i, j)), (count, count)).tocsr()
        sums = np.asarray(links.sum(axis=1)).ravel()
        share = np.divide(1, sums, out=np.zeros(count), where=sums > 0)
        laplacian = sparse.diags((sums > 0).astype(float)) - sparse.diags(share) @ links
        data = sparse.diags(each * np.where(weight > 0, weight, np.where(seen, SEEN, STAY)))
        matrix = data + LAMBDA * laplacian.T @ sparse.diags(soft * each) @ laplacian
        delta = spsolve(matrix.tocsc(), each * weight * t)
    delta[~crease & (weight <= 0) & (abs(delta) * middle <= STILL * unit)] = 0
    way = np.where(crease[:, None], 0, delta[:, None] * normals) * middle
    for _ in range(FOLLOWS):
        way = np.where(crease[:, None], with_planes(vertices, faces, way), way)
    return way


def with_planes(vertices, faces, way) -> np.ndarray:
    """The way of each vertex that best takes the planes of the triangles around it along with their other corners."""
    matrix, right, total = np.zeros((len(vertices), 3, 3)), np.zeros_like(vertices), np.zeros(len(vertices))
    for k in range(3):
        own, a, b = (faces[:, (k + turn) % 3] for turn in range(3))
        across = np.cross(vertices[a] - vertices[own], vertices[b] - vertices[own])
        area = np.linalg.norm(across, axis=1)
        angle = np.arctan2(area, ((vertices[a] - vertices[own]) * (vertices[b] - vertices[own])).sum(axis=1))
        n = across / area[:, None]
        np.add.at(matrix, own, angle[:, None, None] * n[:, :, None] * n[:, None, :])
        np.add.at(right, own, (angle * 0.5 * (n * (way[a] + way[b])).sum(axis=1))[:, None] * n)
        np.add.at(total, own, angle)
    matrix += LOOSE * total[:, None, None] * np.eye(3)
    return np.linalg.solve(matrix, right[..., None])[..., 0]
