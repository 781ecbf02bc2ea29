"""Tables of a study, its record, its plot, and the page that a person opens."""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from pagas_cl.app.report.page import html_page
from pagas_cl.config.version import __version__
from pagas_cl.errors import MissingExtraError, log, need
from pagas_cl.scene.own_files import write_json
from pagas_cl.system.files import replaced, write_text

FILE = "tradeoff.json"
COLUMNS = (("depth", "depth error"), ("normal", "normal error"), ("edges", "near edges"),
           ("unpredicted", "held-out photos"))
_NEARLY = 1.1     # times the least error: a setting that is worth naming where it takes less than
_MUCH_SOONER = 0.7  # of the time
_MARKERS = "osDvP*Xp<h"
_MOST = 1.3      # times the error of the initial depth
_NAMES = {"depth": "mean depth error", "normal": "mean normal error",
          "unpredicted": "1 - correlation of held-out photos"}


def headline(study) -> str:
    """What came out, in one sentence."""
    judged = [point for point in study.points if point.error(study.figure) == point.error(study.figure)]
    if not study.points:
        return "Nothing was measured: the time did not do for a single setting."
    if not judged:
        return "No setting could be judged: there is no truth, and no held-out photo that sees enough of the views."
    what = "of the initial depth's " + ("error" if study.figure == "depth" else "mismatch with held-out photos")
    best = min(judged, key=lambda point: point.error(study.figure))
    least = best.error(study.figure)
    if not least < 1:
        return f'No setting betters the initial depth: the best, "{best.name}", has {least:.1%} {what}.'
    quick = min((point for point in judged if point.error(study.figure) <= _NEARLY * least), key=lambda p: p.seconds)
    text = f'"{best.name}" leaves the least, {least:.1%} {what}, in {best.seconds:.2g} s a view'
    if quick.seconds < _MUCH_SOONER * best.seconds:
        text += f'; "{quick.name}" leaves {quick.error(study.figure):.1%} in {quick.seconds:.2g} s'
    return text + "."


def closing(study) -> list[str]:
    """What was not measured."""
    return [f"Left out for lack of time: {'; '.join(study.left_out)}."] if study.left_out else []


def notes(study) -> list[str]:
    """What a reader has to know, one line each."""
    lines = [f"Device: {study.device}. Views: {', '.join(study.initial)}.",
             "Errors are shares of the initial depth's, means over the views; settings of the Pareto front are marked."]
    if study.figure == "unpredicted":
        lines.append("There is no truth here: the front is of 1 - median correlation of 7x7 patches with photos that "
                     "took no part, a proxy.")
    return lines


def markdown(points) -> str:
    """The table in Markdown; settings of the front in bold."""
    header, rows = _front_table(points)
    names = [f"**{point.name}**" if point.on_front else point.name for point in points]
    return markdown_table(header, [[name, *row[1:]] for name, row in zip(names, rows)])


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]]) + "\n"


def _front_table(points) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the table, one row a point."""
    figures = [(key, name) for key, name in COLUMNS if any(key in p.errors for p in points)]
    header = ["setting", "s per view", "device MB", "view-steps", *(name for _, name in figures)]
    return header, [[p.name, f"{p.seconds:.3g}", f"{p.device_bytes / 1e6:.0f}", f"{p.view_steps:.0f}",
                     *(f"{p.error(key):.3f}" for key, _ in figures)] for p in points]


def write_report(folder: Path, study, device: str) -> Path:
    """Write index.html, tradeoff.json (records of `device`) and, with matplotlib, tradeoff.png; gives the page."""
    write_json(folder / FILE, "tradeoff", {
        "device": device, "figure": study.figure, "initial": study.initial, "left_out": study.left_out,
        "points": [asdict(point) for point in study.points], "records": study.records})
    picture = ""
    if any(point.on_front for point in study.points):
        try:
            plot_front(folder / "tradeoff.png", study.points, study.figure)
            picture = "tradeoff.png"
        except MissingExtraError as error:
            log.warning("no plot: %s", error)
    header, rows = _front_table(study.points)
    page = html_page(
        "pagas-cl tradeoff", notes(study)[1:], ["setting", "number", *header[1:]],
        [[row[0], str(number), *row[1:]] for number, row in enumerate(rows, 1)], picture=picture,
        marked=[point.on_front for point in study.points], headline=headline(study), closing=closing(study),
        legend=["The number is that of the point in the plot."] if picture else [],
        facts=[("views", ", ".join(study.initial)), ("version", f"pagas_cl {__version__}"), ("device", study.device)])
    return write_text(folder / "index.html", page)


def plot_front(path: Path, points, figure: str) -> None:
    """Write a PNG of `points` (study.Point), numbered from 1; errors above _MOST are arrows at the top."""
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
