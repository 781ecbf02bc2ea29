"""Twin of cl_kernels/mesh_rings.cl."""

from __future__ import annotations

import numpy as np


def grouped(numbers, count) -> tuple[np.ndarray, np.ndarray]:
    """As pagas_cl.method.surface.mesh_rings.grouped, of arrays."""
    order = np.argsort(numbers, kind="stable")
    return np.searchsorted(numbers[order], np.arange(count + 1)), order


def rings_of(faces, count) -> dict[str, np.ndarray]:
    """As pagas_cl.method.surface.mesh_rings.rings_of, of arrays."""
    first, order = grouped(faces.ravel(), count)
    others = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
    return {"first": first, "pairs": others.reshape(-1, 2)[order]}
