"""Tables of a study, and the page that a person opens."""

from __future__ import annotations

import json
import logging
from html import escape
from pathlib import Path

from pagas_cl.errors import MissingExtraError
from pagas_cl.report.page import write_text
from pagas_cl.tradeoffs.book import FILE

log = logging.getLogger("pagas_cl")

_COLUMNS = (("depth", "depth error"), ("normal", "normal error"), ("edges", "near edges"),
            ("unpredicted", "held-out photos"))
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: right }
td:first-child, th:first-child { text-align: left } tr.front { background: #e6f2e6; font-weight: 600 }
img { max-width: 100% }
"""


def rows_of(points) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the table, one row a point; errors are shares of the initial depth's."""
    figures = [(key, name) for key, name in _COLUMNS if any(key in p.errors for p in points)]
    header = ["setting", "s per view", "device MB", "view-steps", *(name for _, name in figures)]
    rows = [[p.name, f"{p.seconds:.3g}", f"{p.device_bytes / 1e6:.0f}", f"{p.view_steps:.0f}",
             *(f"{p.error(key):.3f}" for key, _ in figures)] for p in points]
    return header, rows


def markdown(points) -> str:
    """The table in Markdown; settings of the front in bold."""
    header, rows = rows_of(points)
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for point, row in zip(points, rows):
        name = f"**{row[0]}**" if point.on_front else row[0]
        lines.append("| " + " | ".join([name, *row[1:]]) + " |")
    return "\n".join(lines) + "\n"


def notes(study) -> list[str]:
    """What a reader has to know, one line each."""
    lines = [f"Device: {study.device}. Views: {', '.join(study.initial)}.",
            "Errors are shares of the initial depth's, means over the views; settings of the Pareto front are marked."]
    if study.figure == "unpredicted":
        lines.append("There is no truth here: the front is of 1 - median correlation of 7x7 patches with photos that "
                    "took no part, a proxy.")
    elif study.proxy == study.proxy:
        lines.append(f"Held-out photos rank these settings like the true depth error does with a rank correlation of "
                    f"{study.proxy:.2f}.")
    if study.left_out:
        lines.append(f"Left out for lack of time: {'; '.join(study.left_out)}.")
    return lines


def write_report(folder: Path, study, content: dict) -> Path:
    """Write index.html, tradeoff.json and, where matplotlib is there, tradeoff.png; returns the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FILE, json.dumps(content, indent=1) + "\n")
    picture = ""
    if any(point.on_front for point in study.points):
        try:
            from pagas_cl.tradeoffs.plot import plot_front

            plot_front(folder / "tradeoff.png", study.points, study.figure, "error against time")
            picture = '<img src="tradeoff.png" alt="error against time">'
        except MissingExtraError as error:
            log.warning("no plot: %s", error)
    page = folder / "index.html"
    write_text(page, _html(study, picture))
    return page


def _html(study, picture: str) -> str:
    header, rows = rows_of(study.points)
    marks = [' class="front"' if point.on_front else "" for point in study.points]
    body = "".join(f"<tr{mark}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
                   for mark, row in zip(marks, rows))
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = "".join(f"<p>{escape(line)}</p>" for line in notes(study))
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>error against time</title>'
            f"<style>{_STYLE}</style><h1>Error against time</h1>{lines}{picture}"
            f"<table><tr>{head}</tr>{body}</table></html>\n")
