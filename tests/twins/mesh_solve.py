"""Twin of cl_kernels/mesh_solve.cl: the same least squares, solved by SciPy in float64 (method section 10.3)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

LAMBDA, STAY, CREASE, JUMP, LINKINGS, STILL, DETAIL = 4.0, 0.15, 0.1, 0.5, 2, 0.02, 1.5


def ways(vertices, faces, normals, reach, unit, target, weight) -> np.ndarray:
    """Ways delta of the vertices along their normals, (V,) in scene units."""
    middle, count = np.median(unit), len(vertices)
    scaled, each, t = vertices / middle, (middle / unit) ** 2, target / middle
    i, j = np.concatenate([faces[:, [k, m]] for k, m in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))]).T
    soft = np.minimum(1, DETAIL * unit / reach) ** 2
    delta = np.zeros(count)
    for _ in range(LINKINGS):
        bend = (1 - (normals[i] * normals[j]).sum(axis=1)) / CREASE
        length = np.maximum(np.linalg.norm(scaled[i] - scaled[j], axis=1), 0.3)
        steep = abs(delta[i] - delta[j]) / (length * JUMP)
        links = sparse.coo_matrix((1 / ((1 + bend**2) * (1 + steep**2)), (i, j)), (count, count)).tocsr()
        sums = np.asarray(links.sum(axis=1)).ravel()
        laplacian = sparse.identity(count) - sparse.diags(1 / sums) @ links
        data = sparse.diags(each * np.where(weight > 0, weight, STAY))
        matrix = data + LAMBDA * laplacian.T @ sparse.diags(soft * each) @ laplacian
        delta = spsolve(matrix.tocsc(), each * weight * t)
    return np.where((weight > 0) | (abs(delta) * middle > STILL * unit), delta * middle, 0)
