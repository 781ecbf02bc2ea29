"""Accuracy against time over several scenes, as the README's tables have it.

    python tests/bench/scenes.py SCENES --data DATA
    python tests/bench/front.py SCENES OUT [front] [ablation] [--json FILE]     # JSON: rows of `front`

Every part writes OUT/<part>.md, and its records to OUT/<part>/*/tradeoff.json, from which a second run goes on.
"""

from __future__ import annotations

import argparse
import logging
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from record import add_json, record

from pagas_cl.app.tradeoffs.case import BenchmarkCase, loaded, make_cases
from pagas_cl.app.tradeoffs.page import ablation_table, markdown, notes
from pagas_cl.app.tradeoffs.plan import ablation_plan, front_plan
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


def case_of(folder: Path) -> BenchmarkCase:
    """Of a scene written by scenes.py: the first view with a depth, without truth the middle one of those."""
    scene = read_scene(folder)
    depths, truth = ([depth_of(folder / kind, view) for view in scene.views]
                     for kind in ("depth_initial", "depth_true"))
    held_out = [view.name for view in scene.views if view.name.startswith("held_out")] or None
    have = [view.name for view, depth in zip(scene.views, depths) if depth is not None]
    chosen = have[0 if any(t is not None for t in truth) else len(have) // 2]
    return make_cases(scene.views, depths, truth=truth, names=[chosen], held_out=held_out, scene_name=folder.name)[0]


def depth_of(folder, view):
    """The depth map of a view in a folder, (H, W) float32; None where there is none."""
    path = find_depth(folder, view.name)
    return None if path is None else load_depth(path, (view.camera.width, view.camera.height))


def front(cases, out, device, given):
    """The plan on every scene: a table of each, and of all with truth together."""
    settings, lines = [s for s in front_plan() if not given.only or s.group in given.only], []
    judged = {"truth": [b for b in cases if b.truth is not None], "photos": [b for b in cases if b.truth is None]}
    for name, some in judged.items():
        if not some:
            continue
        study = measure(some, settings, device=device, report=out / "front" / name, repeats=given.repeats,
                        executor=given.executor)
        for part in parts_of(study, settings):
            scenes = ", ".join(part.initial)
            lines += [f"## {scenes}", "", *notes(part), "", markdown(part.points)]
            given.rows += [row_of(scenes, point) for point in part.points]
    return lines


def row_of(scenes: str, point) -> dict:
    """A setting in the table of docs/benchmarks.md."""
    columns = (("depth", "depth error"), ("normal", "normal error"), ("edges", "near edges"),
               ("unpredicted", "held-out photos"))
    return {"scenes": scenes, "setting": point.name, "front": "yes" if point.on_front else None,
            "s per view": point.seconds, "device MB": round(point.device_bytes / 1e6), "view-steps": point.view_steps,
            **{name: point.error(key) for key, name in columns}}


def parts_of(study, settings):
    """The study of all views with truth together, where there are several, and of each view alone."""
    known = {name: scores for name, scores in study.initial.items() if "depth" in scores}
    groups = [known] * (len(known) > 1) + [{name: scores} for name, scores in study.initial.items()]
    return [collect(study.records, settings, group, study.device) for group in groups]


def ablation(cases, out, device, given):
    """The paper's ablation of both bases, on every scene."""
    lines = []
    for base in given.bases:
        settings = ablation_plan(base)
        study = measure(cases, settings, device=device, repeats=given.repeats, report=out / "ablation" / base,
                        executor=given.executor)
        order = {s.name: k for k, s in enumerate(settings)}
        for part in parts_of(study, settings):
            rows = sorted(part.points, key=lambda p: order[p.name])
            lines += [f"## {base}: {', '.join(part.initial)}", "", notes(part)[0], "", ablation_table(rows)]
    return lines


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
    parser.add_argument("--workers", type=int, default=0, help="processes that judge while the device goes on")
    add_json(parser)
    given = parser.parse_args()
    given.rows = []
    given.executor = ProcessPoolExecutor(given.workers, get_context("spawn")) if given.workers else None
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.folders = [given.scenes / name for name in given.names if (given.scenes / name).is_dir()]
    cases, device = [loaded(case_of(folder)) for folder in given.folders], open_device(given.device)
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
