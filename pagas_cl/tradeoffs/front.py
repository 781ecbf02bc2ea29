"""The Pareto front, and how well one figure ranks settings like another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Point:
    """One setting over all cases that it ran on.

    Attributes
    ----------
    name, group, paper : str
    seconds : float
        Mean per view.
    device_bytes : int
        Most of any view.
    view_steps : float
        Mean per view.
    errors : dict of str to float
        Mean over the views of each figure as a share of the initial depth's: "depth", "normal", "edges",
        "unpredicted", "unpredicted_mean"; "missing" as it is.
    views : int
    on_front : bool
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


def summarise(settings, records, initial: dict, cases) -> list[Point]:
    """Points of the settings that ran on all of `cases` (names)."""
    points = []
    for setting in settings:
        rows = {r["case"]: r for r in records
                if r["key"] == setting.key and r["case"] in cases and "error" not in r}
        if len(rows) < len(cases):
            continue
        points.append(Point(setting.name, setting.group, setting.paper, _mean(rows, "seconds"),
                            max(r["device_bytes"] for r in rows.values()), _mean(rows, "view_steps"),
                            _errors(rows, initial), len(rows)))
    return points


def _mean(rows, name):
    return float(np.mean([r[name] for r in rows.values()]))


def _errors(rows, initial) -> dict:
    shares: dict[str, list[float]] = {}
    for case, row in rows.items():
        for name, value in row["scores"].items():
            value = float("nan") if value is None else value  # JSON has no nan
            before = initial[case].get(name)
            if name.startswith("unpredicted") and not name.endswith("before"):
                before = row["scores"][f"{name}_before"]
            if name == "missing":
                shares.setdefault(name, []).append(value)
            elif not name.endswith("before") and before:
                shares.setdefault(name, []).append(value / before)
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
    a, b = _ranks(a[both]), _ranks(b[both])
    a, b = a - a.mean(), b - b.mean()
    norm = np.sqrt((a * a).sum() * (b * b).sum())
    return float((a * b).sum() / norm) if norm > 0 else float("nan")


def _ranks(values) -> np.ndarray:
    _, inverse, number = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(number)
    return ((last - number + last - 1) / 2)[inverse]


def fitted_exponent(sizes, seconds) -> float:
    """Slope of log(seconds) over log(sizes): 1 where time is linear in size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
