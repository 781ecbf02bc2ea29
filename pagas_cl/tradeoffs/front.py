"""The Pareto front, its plot, and how well one figure ranks settings like another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import need
from pagas_cl.scene.files import replaced

_GROUPS = ("preset", "effects", "steps", "views a step", "context views", "model", "levels", "solver",
           "staged", "ablation")
_MARKERS = "osDvP*Xp<>"      # one a group, beside its colour
_NAMES = {"depth": "mean depth error", "normal": "mean normal error",
          "unpredicted": "1 - correlation of held-out photos"}


@dataclass(frozen=True)
class Point:
    """One setting over all the cases that it ran on; `paper`: what the paper says of the same change.

    `seconds` and `view_steps` are means per view, `device_bytes` the most of any view. `errors`: mean over the views of
    each of case.score's figures as a share of the initial depth's; "missing" as it is.
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


def plot_front(path, points, figure: str, title: str = "", at_most: float = 1.3) -> Path:
    """Write a PNG of `points` (front.Point) by matplotlib; errors above `at_most` are drawn at the top as arrows."""
    need("matplotlib", "report", "the plot of error against time")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    def place(point):
        return point.seconds, min(point.error(figure), at_most)

    drawing = Figure((7.2, 4.6), layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.add_subplot()
    groups = [g for g in _GROUPS if any(p.group == g for p in points)]
    groups += sorted({p.group for p in points} - set(groups))
    for number, group in enumerate(groups):
        rows = [p for p in points if p.group == group and np.isfinite(p.error(figure))]
        own = _MARKERS[number % len(_MARKERS)]
        for marker, above in ((own, False), ("$\\uparrow$", True)):
            places = [place(p) for p in rows if (p.error(figure) > at_most) == above]
            axes.scatter(*np.reshape(places, (-1, 2)).T, s=22, marker=marker, color=f"C{number}", zorder=2,
                         label=None if above else group)
    front = sorted(place(p) for p in points if p.on_front)
    axes.step(*np.reshape(front, (-1, 2)).T, where="post", color="black", linewidth=1, zorder=1, label="Pareto front")
    for p in points:
        if p.group == "preset" or p.on_front:
            bold = p.group == "preset"
            axes.annotate(p.name, place(p), textcoords="offset points", xytext=(6, 6), fontsize=9 if bold else 7,
                          fontweight="bold" if bold else None)
    axes.axhline(1, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log", xlabel="seconds per view", title=title,
             ylabel=f"{_NAMES.get(figure, figure)}\n(1 = initial depth)")
    for axis in (axes.xaxis, axes.yaxis):  # 0.4 and not 4 x 10^-1
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(_few_minor)
    axes.margins(x=0.12)  # room for a name at the right
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize=7, ncols=2)
    with replaced(path, Path(path).suffix) as beside:
        drawing.savefig(beside, dpi=110)
    return Path(path)


def _few_minor(value, _) -> str:
    """Label of a minor tick: 2 and 5 of each decade, the others run into each other."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""
