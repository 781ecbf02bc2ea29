"""Launches of summary.cl: number, mean and a quantile of rows of numbers, so that few of them leave the device."""

from __future__ import annotations

import numpy as np

from pagas_cl.runtime.program import bind, build
from pagas_cl.runtime.transfer import download, upload
from pagas_cl.splat.constants import SHARED, SUMMARY_GROUP



class Rows:
    """Rows of `count` float32 on the device, NaN = no value, and what they come to.

    Parameters
    ----------
    rules : list of (lowest, highest, share)
        Of each row: the values that its quantile lies between, and the share of the values below it.
    """

    def __init__(self, device, rules, count: int):
        self.device, self.rows, self.count = device, len(rules), count
        self.values = device.memory.buffer(device.context, 4 * self.rows * count)
        self.summary = device.memory.buffer(device.context, 16 * self.rows)
        table = np.zeros((self.rows, 4), np.float32)
        table[:, :3] = rules
        self._rules = upload(device, table)

    @staticmethod
    def nbytes(rows: int, count: int) -> int:
        """Bytes of the device that they take."""
        return rows * (4 * count + 32)

    def summarize(self):
        """The launch that fills `summary`."""
        return bind(build(self.device, "summary.cl", SHARED), "summarize", (self.rows * SUMMARY_GROUP,),
                    (SUMMARY_GROUP,), self.values, self.count, self._rules, self.summary)

    def read(self) -> np.ndarray:
        """`summary` on the host: (rows, 4) of number, mean, quantile, mean square; NaN in a row without values."""
        return download(self.device, self.summary, (self.rows, 4)).astype(np.float64)
