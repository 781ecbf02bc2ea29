"""Accuracy against time over several scenes, as the README's tables have it.

    python tests/bench/scenes.py SCENES --data DATA
    python tests/bench/front.py SCENES OUT [front] [ablation] [scaling] [prediction] [sampling]

Every part writes OUT/<part>.json and OUT/<part>.md (scaling, prediction, sampling: only the latter).
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from pagas_cl.costs import Costs, rungs
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.depthmap import find_depth, load_depth, resize_depth
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import View
from pagas_cl.splat import PhotoStore, refine_levels
from pagas_cl.tradeoffs.ablation import ablation_plan, ablation_table
from pagas_cl.tradeoffs.bench import Bench, loaded, make_benches
from pagas_cl.tradeoffs.front import fitted_exponent
from pagas_cl.tradeoffs.page import markdown, notes
from pagas_cl.tradeoffs.plan import fixed, front_plan
from pagas_cl.tradeoffs.score import score
from pagas_cl.tradeoffs.study import collect, measure

PARTS = ("front", "ablation", "scaling", "prediction", "sampling")


def bench_of(folder: Path) -> Bench:
    """The first view with truth (or a depth) of a scene written by scenes.py."""
    scene = read_scene(folder)
    depths, truth = ([_depth(folder / kind, view) for view in scene.views] for kind in ("depth_initial", "depth_true"))
    held_out = [view.name for view in scene.views if view.name.startswith("held_out")] or None
    first = next(view.name for view, depth in zip(scene.views, depths) if depth is not None)
    if not any(t is not None for t in truth):
        first = scene.views[len(scene.views) // 2].name
    return make_benches(scene.views, depths, truth=truth, names=[first], held_out=held_out, scene_name=folder.name)[0]


def _depth(folder, view):
    path = find_depth(folder, view.name)
    return None if path is None else load_depth(path, (view.camera.width, view.camera.height))


def front(benches, out, device, given):
    """The plan on every scene: a table of each, and of all with truth together."""
    settings, lines = [s for s in front_plan() if not given.only or s.group in given.only], []
    judged = {"truth": [b for b in benches if b.truth is not None], "photos": [b for b in benches if b.truth is None]}
    for name, some in judged.items():
        if not some:
            continue
        study = measure(some, settings, device=device, report=out / "front" / name, repeats=given.repeats,
                        workers=given.workers)
        parts = parts_of(study, settings)
        for part in parts if len(some) > 1 else parts[:1]:
            lines += [f"## {', '.join(part.initial)}", "", *notes(part), "", markdown(part.points)]
    return lines


def parts_of(study, settings):
    """The study, and the same of each of its views alone."""
    alone = ({name: scores} for name, scores in study.initial.items())
    return [study, *(collect(study.records, settings, initial, study.device) for initial in alone)]


def ablation(benches, out, device, given):
    """The paper's ablation of both bases, over the scenes with truth."""
    lines, some = [], [b for b in benches if b.truth is not None]
    for base in ("paper", "balanced"):
        settings = ablation_plan(base)
        study = measure(some, settings, device=device, repeats=given.repeats, report=out / "ablation" / base,
                        workers=given.workers)
        order = {s.name: k for k, s in enumerate(settings)}
        for part in parts_of(study, settings):
            rows = sorted(part.points, key=lambda p: order[p.name])
            lines += [f"## {base}: {', '.join(part.initial)}", "", notes(part)[0], "", ablation_table(rows)]
    return lines


def scaling(benches, out, device, given):
    """Fitted exponents of time against pixels, views and steps, each over a range of 16."""
    base, bench = fixed("balanced"), benches[0]
    shares = np.array([1, 2**0.5, 2, 2**1.5, 4]) * given.scale
    sizes, times = [], []
    for share in shares:
        big = resized(bench, share, 4)
        sizes.append(big.pixels)
        times.append(_seconds(big, base.with_settings(pyramid__steps=(200,)), device))
    lines = [_line("pixels", sizes, times)]
    big = resized(bench, given.scale, 12)
    big = replace(big, contexts=(big.contexts * 64)[:64])
    for unit, values, change in (
            ("steps", (100, 200, 400, 800, 1600), lambda n: base.with_settings(pyramid__steps=(n,))),
            ("context views, all in every step", (4, 8, 16, 32, 64),
             lambda n: base.with_settings(context__number=n, solver__views_per_step=0, pyramid__steps=(60,)))):
        times, rest = [], []
        for n in values:
            times.append(_seconds(big, change(n), device))
            rest.append(times[-1] - _seconds(big, change(n).with_settings(pyramid__steps=(0,)), device))
        lines += [_line(unit, values, times), _line(f"{unit}, the steps alone", values, rest)]
    return [str(device.info), "", "| against | values | seconds | exponent |", "|---|---|---|---|", *lines, ""]


def _line(name, values, times):
    return (f"| {name} | {', '.join(f'{v:g}' for v in values)} | {', '.join(f'{t:.4g}' for t in times)} | "
            f"{fitted_exponent(values, times):.3f} |")


def resized(bench: Bench, share: float, contexts: int) -> Bench:
    """The bench at another size, photos by bicubic interpolation: for times, not for errors."""
    def view(old):
        width, height = round(old.camera.width * share), round(old.camera.height * share)
        photo = Image.fromarray(old.load_image()).resize((width, height))
        return View(old.camera.resized(width, height), np.asarray(photo))

    target = view(bench.target)
    depth = resize_depth(bench.initial, target.camera.width, target.camera.height)
    others = [view(v) for v in bench.contexts[:contexts]]
    return replace(bench, target=target, contexts=others, initial=depth, held_out=[])


def _seconds(bench, config, device, repeats=3):
    photos, times = PhotoStore(device), []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        refine_levels(bench.target, bench.contexts[:config.context.number], bench.initial, config, device, photos)
        times.append(time.perf_counter() - start)
    return min(times[1:])


def prediction(benches, out, device, given):
    """Expected time per view beside the time of refine_views, photos read from files."""
    from pagas_cl.refine import refine_views

    lines = [str(device.info), "", "| scene | settings | views | expected s per view | taken | ratio |",
             "|---|---|---|---|---|---|"]
    for folder in given.folders:
        scene = read_scene(folder)
        depths = [_depth(folder / "depth_initial", view) for view in scene.views]
        names = [view.name for view, depth in zip(scene.views, depths) if depth is not None][:given.views]
        costs = Costs(scene.views, depths, device, names)
        for name, config in [rung for rung in rungs() if rung[0] in ("fast", "balanced", "accurate")]:
            expected, times = costs.seconds(config), []
            for _ in range(2):  # the least: what else the machine does only adds
                start = time.perf_counter()
                refine_views(scene.views, depths, names=names, config=config, device=device)
                times.append((time.perf_counter() - start) / len(names))
            taken = min(times)
            cells = folder.name, name, f"{len(names)}", f"{expected:.4g}", f"{taken:.4g}", f"{expected / taken:.3f}"
            lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def sampling(benches, out, device, given):
    """What spending the later steps only on some tiles could gain at best.

    Tiles of 32 pixels take their depth from the longer run where a guess says that it pays, at a cost in proportion and
    no overhead, beside a run of all tiles with fewer steps for the same cost. The guesses: how far the short run moved
    the tile (its change from the initial depth), its texture, and the truth itself (the best that any guess can be).
    """
    lines = [str(device.info), "",
             "| scene | view-steps a pixel | uniform | by change | by texture | by truth |",
             "|---|---|---|---|---|---|"]
    base, photos = fixed("balanced"), PhotoStore(device)
    for bench in (b for b in benches if b.truth is not None):
        def depth_after(steps):
            rate = 0.06 if steps < 75 else 0.04
            config = base.with_settings(pyramid__steps=(steps,), solver__rate=rate)
            return refine_levels(bench.target, bench.contexts, bench.initial, config, device, photos).depth

        before = score(replace(bench, held_out=[]), bench.initial)["depth"]
        short, long = depth_after(40), depth_after(150)
        for share in (0.25, 0.5, 0.75):
            steps = round(40 + share * 150)  # the tiles that go on start anew: 150 steps more for them
            rows = [score(replace(bench, held_out=[]), depth_after(min(steps, 150)))["depth"]]
            for gain in _gains(bench, short, long):
                chosen = _best_tiles(gain, share)
                rows.append(score(replace(bench, held_out=[]), np.where(chosen, long, short))["depth"])
            lines.append(f"| {bench.name} | {steps} | " + " | ".join(f"{row / before:.4f}" for row in rows) + " |")
    return [*lines, ""]


def _gains(bench, short, long):
    unit = np.where(bench.parallax > 0, bench.parallax, np.inf)
    grey = bench.target.load_image().astype(float).mean(axis=2)
    texture = np.hypot(*np.gradient(grey))
    gain = np.where(bench.truth > 0, np.abs(short - bench.truth) - np.abs(long - bench.truth), 0)
    return np.abs(short - bench.initial) / unit, texture, gain


def _best_tiles(gain, share, tile=32):
    """Pixels of the `share` of tiles with the largest mean gain, bool (H, W)."""
    rows, columns = (-(-n // tile) for n in gain.shape)
    padded = np.zeros((rows * tile, columns * tile))
    padded[:gain.shape[0], :gain.shape[1]] = gain
    mean = padded.reshape(rows, tile, columns, tile).mean(axis=(1, 3))
    chosen = mean >= np.quantile(mean, 1 - share)
    return np.kron(chosen, np.ones((tile, tile), bool))[:gain.shape[0], :gain.shape[1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("parts", nargs="*", default=PARTS)
    parser.add_argument("--names", nargs="*", default=("relief", "bar", "motorcycle", "dtu"))
    parser.add_argument("--only", nargs="*", help="groups of the plan")
    parser.add_argument("--device")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0, help="of the smallest size of `scaling`")
    parser.add_argument("--views", type=int, default=10, help="of `prediction`")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.folders = [given.scenes / name for name in given.names if (given.scenes / name).is_dir()]
    benches, device = [loaded(bench_of(folder)) for folder in given.folders], open_device(given.device)
    given.out.mkdir(parents=True, exist_ok=True)
    for part in given.parts:
        start = time.time()
        lines = globals()[part](benches, given.out, device, given)
        (given.out / f"{part}.md").write_text("\n".join(lines) + "\n")
        logging.info("%s: %.0f s", part, time.time() - start)


if __name__ == "__main__":
    main()
