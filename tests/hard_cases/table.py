"""The table of hard cases, measured on a device and written into README.md next to this file.

    python tests/hard_cases/table.py --measure FIGURES.json [--large]     # on the device PAGAS_CL_DEVICE names
    python tests/hard_cases/table.py FIGURES.json ...                     # each file becomes one column
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from itertools import chain
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

PAGE = Path(__file__).with_name("README.md")
COLUMNS = {"CPU": "PoCL", "GPU": "NVIDIA GPU"}
HEAD = "| case | tolerance | PoCL | NVIDIA GPU | worst / tolerance |"
NOT_RUN = "not run"


def measure(path: Path, large: bool) -> int:
    """Run every case on this machine's device; figures to `path`. The number of failures."""
    from support.hard_cameras import run_cameras
    from support.hard_cases import run_cases
    from support.hard_sizes import run_large

    from pagas_cl.runtime.device import open_device

    device, rows, start = open_device(), [], time.perf_counter()

    def note(outcome):
        nonlocal start
        now = time.perf_counter()
        rows.append({"case": outcome.case.name, "blend": outcome.blend, "tolerance": outcome.case.tolerance,
                     "worst": outcome.worst, "faults": outcome.faults, "seconds": round(now - start, 2)})
        start = now
        sys.stdout.write(f"{outcome.case.name:<48}{outcome.blend:<12}{outcome.worst:>10.1e}  "
                         f"{'; '.join(outcome.faults) or 'ok'}\n")

    for outcome in chain(run_cases(device), run_cameras(device), run_large(device) if large else ()):
        note(outcome)
    failed = sum(bool(row["faults"]) for row in rows)
    path.write_text(json.dumps({"device": device.info.title, "kind": device.info.kind, "rows": rows}, indent=1))
    sys.stdout.write(f"{device.info}: {len(rows)} runs of {len({r['case'] for r in rows})} cases, {failed} failed\n")
    return failed


def write_page(files: list[Path]) -> None:
    """Put the figures of `files` into the page's table, one column a device; other columns stay."""
    text = PAGE.read_text()
    start, end = text.index("| case | tolerance"), len(text)
    lines = text[start:end].splitlines()
    table = [line for line in lines if line.startswith("|")]
    after = [line for line in lines if not line.startswith("|")]
    names = _cells(table[0])
    rows = {cells[0]: dict(zip(names, cells)) for cells in map(_cells, table[2:])}
    for file in files:
        found = json.loads(file.read_text())
        column = COLUMNS[found["kind"]]
        for name in dict.fromkeys(row["case"] for row in found["rows"]):
            mine = [row for row in found["rows"] if row["case"] == name]
            row = rows.setdefault(name, {})
            row["tolerance"] = ", ".join(dict.fromkeys(f"{r['tolerance']:.0e}" for r in mine))
            row[column] = ", ".join(f"{r['worst']:.1e}" + ("" if not r["faults"] else " FAILED") for r in mine)
    out = [HEAD, "|---" * len(_cells(HEAD)) + "|"]
    for name, row in rows.items():
        cells = [row.get(column, NOT_RUN) for column in COLUMNS.values()]
        out.append(f"| {name} | {row['tolerance']} | {' | '.join(cells)} | {_share(row['tolerance'], cells)} |")
    PAGE.write_text(text[:start] + "\n".join([*out, *after]).rstrip("\n") + "\n")


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _share(tolerance: str, cells: list[str]) -> str:
    """The largest figure of a row as a share of its tolerance."""
    tolerances = [float(t) for t in tolerance.split(", ")]
    shares = [0.0]
    for cell in cells:
        for place, figure in enumerate(re.findall(r"\d\.\de[-+]\d+", cell)):
            shares.append(float(figure) / tolerances[min(place, len(tolerances) - 1)])
    return f"{max(shares):.2g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figures", nargs="*", type=Path)
    parser.add_argument("--measure", type=Path, metavar="FIGURES")
    parser.add_argument("--large", action="store_true", help="12 and 17 megapixels too: a GPU")
    chosen = parser.parse_args()
    if chosen.measure:
        return 1 if measure(chosen.measure, chosen.large) else 0
    write_page(chosen.figures)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
