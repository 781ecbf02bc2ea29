"""How far a refined depth counts in the fusion: as far as it is sure, and no less than a setting says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Confidence:
    """The confidence of a DepthResult, at least `least`: an array (H, W) that is made when NumPy asks for it."""

    result: object
    least: float

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.maximum(self.result.confidence, self.least).astype(dtype or np.float32, copy=False)


def weights_of(results, least: float) -> list[Confidence] | None:
    """Weights of the depth maps for surface.fuse.fuse; None where all depths count alike."""
    return None if least == 1 else [Confidence(result, least) for result in results]
