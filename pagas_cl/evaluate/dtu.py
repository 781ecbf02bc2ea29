"""DTU's own files: where its scanner could see (ObsMask) and the table that its objects stand on (Plane)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.evaluate.clouds import VisibleSpace


def load_visible(path) -> VisibleSpace:
    """Read ObsMask<scan>_10.mat: ObsMask (bool grid), BB (two corners, mm), Res (voxel, mm)."""
    data = _load(path, "ObsMask", "BB", "Res")
    box = np.asarray(data["BB"], np.float64).reshape(2, 3)
    return VisibleSpace(np.asarray(data["ObsMask"], bool), box[0], box[1], float(np.ravel(data["Res"])[0]))


def load_ground(path) -> np.ndarray:
    """Read Plane<scan>.mat: P, float64 of shape (4,)."""
    return np.asarray(_load(path, "P")["P"], np.float64).ravel()


def _load(path, *names):
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {str(path)!r}")
    need("scipy", "evaluate", "reading DTU's .mat files")
    from scipy.io import loadmat

    try:
        data = loadmat(path)
    except (ValueError, NotImplementedError) as error:
        raise InputError(f"{str(path)!r} is no MATLAB file that SciPy reads: {error}") from error
    missing = [name for name in names if name not in data]
    if missing:
        raise InputError(f"{str(path)!r} has no variable {missing[0]!r}, expected {', '.join(names)}")
    return data
