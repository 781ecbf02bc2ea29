"""Write docs/benchmarks.md from tests/bench/results/*.json: `python tests/bench/tables.py`."""

from __future__ import annotations

import json
import re
from pathlib import Path

from record import table

HERE = Path(__file__).resolve().parent
PAGE = HERE.parents[1] / "docs" / "benchmarks.md"
HEAD = """# Benchmarks

Written by `python tests/bench/tables.py` from `tests/bench/results/*.json`: change those, not this page. A benchmark
writes such a file with `--json FILE`. Commands are those of the code that is named; today's scripts have `--json FILE`
in place of OUT. "Not recorded": the notes of the measurement do not say it; without a command, they give none.

A depth error of one pixel of parallax moves the point by one pixel in a neighbouring photo. What was learnt, and what
was tried and not kept: [tests/bench/README.md](../tests/bench/README.md).
"""


def results() -> list[dict]:
    """All results by file name; numbers are texts, with the digits that the files have."""
    return [json.loads(file.read_text(encoding="utf-8"), parse_float=str, parse_int=str)
            for file in sorted((HERE / "results").glob("*.json"))]


def section(result: dict) -> str:
    """One result as Markdown."""
    device, commit, date = (result[key] or "not recorded" for key in ("device", "commit", "date"))
    where = f"Device: {device}; code: {commit}; date: {date}"
    command = f"    {result['command']}\n\n" if result["command"] else ""
    return f"## {result['title']}\n\n{result['measured']}\n\n{command}{where}.\n\n{table(result['rows'])}\n"


def anchor(title: str) -> str:
    """The part of a link after # that leads to a section."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def page() -> str:
    """docs/benchmarks.md."""
    found = results()
    contents = "\n".join(f"- [{result['title']}](#{anchor(result['title'])})" for result in found)
    return "\n".join([HEAD, contents, "", *map(section, found)])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
