"""What a benchmark measured, printed as a table and written as JSON that `tables.py` reads."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from datetime import date
from math import isfinite
from numbers import Integral
from pathlib import Path

DIGITS = 4      # significant ones of a figure that a script measures


def add_json(parser: argparse.ArgumentParser) -> None:
    """The option --json of every benchmark."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there; in tests/bench/results/ "
                        "they become part of docs/benchmarks.md")


def record(title: str, measured: str, device: str | None, rows: list[dict], file: Path | None = None) -> None:
    """Print the rows as a table; where `file` is given, write them with date, commit, device and command.

    measured : one sentence that says what was measured, on what. rows : column to number or text, one of each row.
    """
    rows = [{column: _rounded(value) for column, value in row.items()} for row in rows]
    sys.stdout.write(f"{device or 'no device'}\n\n{table(rows)}\n")
    if file is not None:
        head = {"title": title, "measured": measured, "date": f"{date.today()}", "commit": commit(), "device": device,
                "command": " ".join(["python", *sys.argv])}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(as_json(head, rows))


def as_json(head: dict, rows: list[dict]) -> str:
    """One line for each entry of `head` and for each row."""
    entries = [f" {json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}" for name, value in head.items()]
    lines = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in rows)
    return "{\n" + ",\n".join([*entries, f' "rows": [\n{lines}\n ]']) + "\n}\n"


def commit() -> str | None:
    """Short hash of the checked out commit, with "+" where files differ from it; None outside a repository."""
    found = subprocess.run(["git", "describe", "--always", "--dirty=+", "--exclude=*"], cwd=Path(__file__).parent,
                           capture_output=True, text=True)
    return found.stdout.strip() or None


def table(rows: list[dict]) -> str:
    """Markdown; columns are those of all rows, in the order in which they appear first."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = [columns, ["---"] * len(columns), *([_cell(row.get(column)) for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value) -> str:
    return "" if value is None else str(value)


def _rounded(value):
    if value is None or isinstance(value, (str, Integral)):
        return value
    return float(f"{value:.{DIGITS}g}") if isfinite(value) else None
