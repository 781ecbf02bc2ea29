"""Judging depth maps here, or in processes of their own while the device works on."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from pagas_cl.tradeoffs.case import BenchmarkCase
from pagas_cl.tradeoffs.score import score

_CASES: list[BenchmarkCase] = []  # of a judging process


class Judges:
    """Context of a judge: `judge(number, depth, then)` calls `then(scores)` now or later, at the latest on leaving.

    Parameters
    ----------
    cases : list of BenchmarkCase
    workers : int
        Processes; 0 judges in this one.
    """

    def __init__(self, cases, workers: int):
        self.cases, self.waiting = cases, []
        self.pool = ProcessPoolExecutor(workers, get_context("spawn"), _take, (cases,)) if workers else None

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if self.pool is not None:
            self._collect(wait=kind is None)
            self.pool.shutdown(cancel_futures=kind is not None)

    def judge(self, number: int, depth, then):
        if self.pool is None:
            then(score(self.cases[number], depth))
            return
        self.waiting.append((self.pool.submit(_score, number, depth), then))
        self._collect(wait=False)

    def _collect(self, wait: bool):
        left = []
        for future, then in self.waiting:
            if wait or future.done():
                then(future.result())
            else:
                left.append((future, then))
        self.waiting = left


def _take(cases):
    _CASES[:] = cases


def _score(number: int, depth: np.ndarray) -> dict:
    return score(_CASES[number], depth)
