"""The Pareto front, and how well one figure ranks settings like another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Point:
    """One setting over all the cases that it ran on.

    `seconds` and `view_steps` are means per view, `device_bytes` the most of any view. `errors`: mean over the views of
    each figure as a share of the initial depth's ("depth", "normal", "edges", "unpredicted", "unpredicted_mean");
    "missing" as it is. `paper`: what the paper says of the same change.
    """

    name: str
    group: str
    paper: str
    seconds: float
    device_bytes: int
    view_steps: float
    errors: dict
    views: int
    on_front: bool = False

    def error(self, which: str) -> float:
        return self.errors.get(which, float("nan"))


def summarise(settings, records, initial: dict) -> list[Point]:
    """Points of the settings that ran on all cases of `initial`: the name of each -> scores of its initial depth."""
    points = []
    for setting in settings:
        rows = {r["case"]: r for r in records
                if r["key"] == setting.key and r["case"] in initial and "error" not in r}
        if len(rows) == len(initial):
            seconds, steps = (float(np.mean([r[name] for r in rows.values()])) for name in ("seconds", "view_steps"))
            points.append(Point(setting.name, setting.group, setting.paper, seconds,
                                max(r["device_bytes"] for r in rows.values()), steps, _errors(rows, initial),
                                len(rows)))
    return points


def _errors(rows, initial) -> dict[str, float]:
    shares: dict[str, list[float]] = {}
    for case, row in rows.items():
        scores = {name: float("nan") if value is None else value for name, value in row["scores"].items()}  # JSON: null
        before = {**initial[case], **{name.removesuffix("_before"): value for name, value in scores.items()
                                      if name.endswith("_before")}, "missing": 1.0}
        for name, value in scores.items():
            if not name.endswith("before") and before.get(name):
                shares.setdefault(name, []).append(value / before[name])
    return {name: float(np.mean(values)) for name, values in shares.items() if len(values) == len(rows)}


def pareto(costs, errors) -> np.ndarray:
    """Which points no other one beats: no cheaper or equal one has a smaller error. bool (n,)."""
    costs, errors = np.asarray(costs, float), np.asarray(errors, float)
    front, best = np.zeros(len(costs), bool), np.inf
    for k in np.lexsort((errors, costs)):
        if errors[k] < best:
            front[k], best = True, errors[k]
    return front


def rank_correlation(a, b) -> float:
    """Spearman's rank correlation, equal values sharing their mean rank; nan below three points."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < 3:
        return float("nan")
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(_ranks(a[both]), _ranks(b[both]))[0, 1])


def _ranks(values) -> np.ndarray:
    _, inverse, number = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(number)
    return ((last - number + last - 1) / 2)[inverse]
