"""Tables of a study, its record, and the page that a person opens."""

from dataclasses import asdict
from pathlib import Path

from pagas_cl.app.report.page import html_page
from pagas_cl.app.tradeoffs.front import plot_front
from pagas_cl.config.version import __version__
from pagas_cl.errors import MissingExtraError, log
from pagas_cl.scene.own_files import write_json
from pagas_cl.system.files import write_text

FILE = "tradeoff.json"
COLUMNS = (("depth", "depth error"), ("normal", "normal error"), ("edges", "near edges"),
           ("unpredicted", "held-out photos"))
_NEARLY = 1.1     # times the least error: a setting that is worth naming where it takes less than
_MUCH_SOONER = 0.7  # of the time


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
    """A table in Markdown."""
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
