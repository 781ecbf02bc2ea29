"""Twin of splat/summary: what rows of numbers come to."""

from __future__ import annotations

import numpy as np


def summarize(row: np.ndarray, share: float) -> tuple[float, float, float, float]:
    """How many values there are, their mean, the quantile with `share` of them below it, the mean of their squares; NaN
    is left out."""
    there = row[np.isfinite(row)]
    if not there.size:
        return 0, np.nan, np.nan, np.nan
    return there.size, there.mean(), np.quantile(there, share), (there**2).mean()
