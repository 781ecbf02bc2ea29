"""Points of files, for tests that only ask whether they are read."""

import numpy as np

from pagas_cl.app.evaluate.clouds import extent, read_shape, sample_surface


def load_points(path) -> np.ndarray:
    """Points (n, 3) of a file of a mesh, every thousandth of its extent, or of a cloud's, as they are."""
    points, faces = read_shape(path)
    return points if faces is None else sample_surface(points, faces, extent(points) / 1000)
