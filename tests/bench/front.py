"""Accuracy against time over several scenes, as the README's tables have it.

    python tests/bench/scenes.py SCENES --data DATA
    python tests/bench/front.py SCENES OUT [front] [ablation] [--json FILE]     # JSON: rows of `front`

Every part writes OUT/<part>.md, and its records to OUT/<part>/*/tradeoff.json, from which a second run goes on.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.record import add_json, record
from bench.settings import ablation_plan, every_setting

from pagas_cl.app.tradeoffs.case import BenchmarkCase, loaded, make_cases
from pagas_cl.app.tradeoffs.page import COLUMNS, markdown, markdown_table, notes
from pagas_cl.app.tradeoffs.study import collect, measure
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.depthmap import find_depth, load_depth
from pagas_cl.scene.readers import read_scene

TITLE = "All settings: error against time"
MEASURED = ("What settings reach: errors as shares of the input's, away from depth edges and near them; `held-out "
            "photos`: 1 - median correlation of 7 x 7 patches with photos that took no part, as a share of the "
            "input's; seconds from photos on the device to the depth on the host; `front`: no other setting is better "
            "in both.")
PARTS = ("front", "ablation")
SAME = 0.02      # relative changes of an error below this count as none


def case_of(folder: Path) -> BenchmarkCase:
    """Of a scene written by scenes.py: the first view with a depth, without truth the middle one of those."""
    scene = read_scene(folder)
    depths, truth = ([depth_of(folder / kind, view) for view in scene.views]
                     for kind in ("depth_initial", "depth_true"))
    held_out = [view.name for view in scene.views if view.name.startswith("held_out")] or None
    have = [view.name for view, depth in zip(scene.views, depths) if depth is not None]
    chosen = have[0 if any(t is not None for t in truth) else len(have) // 2]
    case = make_cases(scene.views, depths, truth=truth, names=[chosen], held_out=held_out)[0]
    return replace(case, name=f"{folder.name}/{case.name}")


def depth_of(folder, view):
    """The depth map of a view in a folder, (H, W) float32; None where there is none."""
    path = find_depth(folder, view.name)
    return None if path is None else load_depth(path, (view.camera.width, view.camera.height))


def front(cases, out, device, given):
    """The plan on every scene: a table of each, and of all with truth together."""
    settings, lines = [s for s in every_setting() if not given.only or s.group in given.only], []
    judged = {"truth": [b for b in cases if b.truth is not None], "photos": [b for b in cases if b.truth is None]}
    for name, some in judged.items():
        if not some:
            continue
        study = measure(some, settings, device=device, report=out / "front" / name, repeats=given.repeats)
        for part in parts_of(study, settings):
            scenes = ", ".join(part.initial)
            lines += [f"## {scenes}", "", *notes(part), *proxy(part.points), "", markdown(part.points)]
            given.rows += [row_of(scenes, point) for point in part.points]
    return lines


def proxy(points) -> list[str]:
    """How well photos that took no part rank the settings, where both can be judged: one line or none."""
    found = rank_correlation(*([p.error(which) for p in points] for which in ("depth", "unpredicted")))
    if np.isnan(found):
        return []
    return ["Held-out photos rank these settings like the true depth error does with a rank correlation of "
            f"{found:.2f}."]


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


def row_of(scenes: str, point) -> dict:
    """A setting in the table of docs/benchmarks.md."""
    return {"scenes": scenes, "setting": point.name, "front": "yes" if point.on_front else None,
            "s per view": point.seconds, "device MB": round(point.device_bytes / 1e6), "view-steps": point.view_steps,
            **{name: point.error(key) for key, name in COLUMNS}}


def parts_of(study, settings):
    """The study of all views with truth together, where there are several, and of each view alone."""
    known = {name: scores for name, scores in study.initial.items() if "depth" in scores}
    groups = [known] * (len(known) > 1) + [{name: scores} for name, scores in study.initial.items()]
    return [collect(study.records, settings, group, study.device) for group in groups]


def ablation(cases, out, device, given):
    """The paper's ablation of both bases, on every scene."""
    lines = []
    for base in given.bases:
        settings = ablation_plan(base, given.depths)
        paper = {row.name: row.paper for row in settings}
        study = measure(cases, settings, device=device, repeats=given.repeats, report=out / "ablation" / base)
        order = {s.name: k for k, s in enumerate(settings)}
        for part in parts_of(study, settings):
            rows = sorted(part.points, key=lambda p: order[p.name])
            lines += [f"## {base}: {', '.join(part.initial)}", "", notes(part)[0], "", ablation_table(rows, paper)]
    return lines


def ablation_table(points, paper: dict[str, str]) -> str:
    """The rows of an ablation in Markdown, with what the paper says of each name; `points` hold the base: its name has
    no colon.

    "here" compares the first of the errors with the base's.
    """
    base = next((p for p in points if ":" not in p.name), None)
    figures = [(key, name) for key, name in COLUMNS if key != "edges" and any(key in p.errors for p in points)]
    header = ["change", *(name for _, name in figures), "here", "s per view", "device MB", "paper"]
    return markdown_table(header, [
        [_kept(p), *(f"{p.error(key):.3f}" if p.error(key) == p.error(key) else "-" for key, _ in figures),
         _compared(p, base, figures[0][0]), f"{p.seconds:.3g}", f"{p.device_bytes / 1e6:.0f}", paper[p.name]]
        for p in points])


def _kept(point) -> str:
    missing = point.errors.get("missing", 0)
    kept = f" ({1 - missing:.0%} of the pixels kept)" if missing > 0.005 else ""
    return point.name.rpartition(": ")[2] + kept


def _compared(point, base, key) -> str:
    if base is None or point is base:
        return ""
    change = point.error(key) / base.error(key) - 1
    if change != change:
        return "-"
    return "same" if abs(change) < SAME else f"{'worse' if change > 0 else 'better'}, {change:+.0%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("parts", nargs="*", default=PARTS)
    parser.add_argument("--names", nargs="*", default=("relief", "bar", "motorcycle", "dtu"))
    parser.add_argument("--only", nargs="*", help="groups of the plan of `front`")
    parser.add_argument("--bases", nargs="*", default=("paper", "balanced"), help="presets of `ablation`")
    parser.add_argument("--device")
    parser.add_argument("--repeats", type=int, default=1)
    add_json(parser)
    given = parser.parse_args()
    given.rows = []
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.folders = [given.scenes / name for name in given.names if (given.scenes / name).is_dir()]
    cases, device = [loaded(case_of(folder)) for folder in given.folders], open_device(given.device)
    given.depths = {case.name: [depth_of(folder / "depth_initial", view) for view in case.contexts]
                    for case, folder in zip(cases, given.folders)}
    given.out.mkdir(parents=True, exist_ok=True)
    for part in given.parts:
        start = time.time()
        lines = globals()[part](cases, given.out, device, given)
        (given.out / f"{part}.md").write_text("\n".join(lines) + "\n")
        logging.info("%s: %.0f s", part, time.time() - start)
    if given.rows:
        record(TITLE, MEASURED, device.info.title, given.rows, given.json)


if __name__ == "__main__":
    main()
