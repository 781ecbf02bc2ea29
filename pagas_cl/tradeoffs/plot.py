"""The plot: error over time, every setting a dot, the Pareto front a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pagas_cl.errors import need
from pagas_cl.scene.files import replaced

_GROUPS = ("preset", "effects", "steps", "views a step", "context views", "model", "levels", "solver",
           "staged", "ablation")
_NAMES = {"depth": "mean depth error", "normal": "mean normal error",
          "unpredicted": "1 - correlation of held-out photos"}


def plot_front(path, points, figure: str, title: str = "", at_most: float = 1.3) -> Path:
    """Write a PNG of `points` (front.Point); errors above `at_most` are drawn at the top as arrows.

    Needs matplotlib.
    """
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
        for marker, above in (("o", False), ("^", True)):
            places = [place(p) for p in rows if (p.error(figure) > at_most) == above]
            axes.scatter(*np.reshape(places, (-1, 2)).T, s=22, marker=marker, color=f"C{number}", zorder=2,
                         label=None if above else group)
    front = sorted(place(p) for p in points if p.on_front)
    axes.step(*np.reshape(front, (-1, 2)).T, where="post", color="black", linewidth=1, zorder=1, label="Pareto front")
    for p in points:
        if p.group == "preset":
            axes.annotate(p.name, place(p), textcoords="offset points", xytext=(6, 6), fontsize=9, fontweight="bold")
    axes.axhline(1, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log", xlabel="seconds per view", title=title,
             ylabel=f"{_NAMES.get(figure, figure)}\n(1 = initial depth)")
    for axis in (axes.xaxis, axes.yaxis):  # 0.4 and not 4 x 10^-1
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(_few_minor)
    axes.margins(x=0.12)  # room for a name at the right
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize=7, ncols=2)
    path = Path(path)
    with replaced(path, path.suffix) as beside:
        drawing.savefig(beside, dpi=110)
    return path


def _few_minor(value, _) -> str:
    """Label of a minor tick: 2 and 5 of each decade, the others run into each other."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""
