"""The Pareto front, and its plot."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import need
from pagas_cl.system.files import replaced

_MARKERS = "osDvP*Xp<h"
_MOST = 1.3      # times the error of the initial depth
_NAMES = {"depth": "mean depth error", "normal": "mean normal error",
          "unpredicted": "1 - correlation of held-out photos"}


@dataclass(frozen=True)
class Point:
    """One setting over all the cases that it ran on.

    `seconds` and `view_steps` are means per view, `device_bytes` the most of any view. `errors`: mean over the views of
    each of case.score's figures as a share of the initial depth's; "missing" as it is.
    """

    name: str
    group: str
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
            points.append(Point(setting.name, setting.group, seconds,
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


def plot_front(path: Path, points, figure: str) -> None:
    """Write a PNG of `points` (front.Point) by matplotlib, each with its place among them, from 1; errors above _MOST
    are drawn at the top as arrows."""
    need("matplotlib", "report", "the plot of error against time")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, NullLocator

    def place(point):
        return point.seconds, min(point.error(figure), _MOST)

    drawing = Figure((9.6, 6.4), layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.add_subplot()
    groups = sorted({p.group for p in points}, key=lambda group: (group != "preset", group))
    for number, group in enumerate(groups):
        rows = [p for p in points if p.group == group and np.isfinite(p.error(figure))]
        for marker, above in ((_MARKERS[number % len(_MARKERS)], False), ("^", True)):
            places = [place(p) for p in rows if (p.error(figure) > _MOST) == above]
            axes.scatter(*np.reshape(places, (-1, 2)).T, s=28, marker=marker, color=f"C{number}", zorder=2,
                         edgecolors="white", linewidths=0.5, label=None if above else group)
    front = sorted(place(p) for p in points if p.on_front)
    axes.step(*np.reshape(front, (-1, 2)).T, where="post", color="black", linewidth=1, zorder=1, label="Pareto front")
    axes.axhline(1, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log", xlabel="time of a view (seconds)", title="error against time",
             ylabel=f"{_NAMES.get(figure, figure)}\n(1 = that of the initial depth)")
    axes.margins(x=0.12)  # room for a name at the right
    for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = _ticks(*ends)
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter("{x:g}")  # 0.4 and not 4 x 10^-1
        axis.set_minor_locator(NullLocator())
    axes.grid(True, alpha=0.2)
    drawing.legend(loc="outside lower center", fontsize=8, ncols=6, frameon=False)
    for number, point in enumerate(points, 1):
        axes.annotate(f"{number} {point.name}" if point.group == "preset" else str(number), place(point), (4, 4),
                      textcoords="offset points", fontsize=7)
    with replaced(path, path.suffix) as temporary:
        drawing.savefig(temporary, dpi=110)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers in a logarithmic range: as few as are at least four, at most a dozen."""
    whole = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7), np.arange(10, 100) / 10):
        ticks = [float(f"{digit * 10.0**power:.3g}") for power in whole for digit in digits]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if len(ticks) >= 4:
            break
    return ticks[::-(-len(ticks) // 12) or 1]
