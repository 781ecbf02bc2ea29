"""Real photos, view by view: held-out photos through the input, refined depth, and refined depth with refined cameras.

    python tests/bench/by_view.py hololens_rgbd OUT
    python tests/bench/by_view.py dtu_scan24 OUT --mesh dtu_scan24/derived/mesh_coarse.ply --share 0.5 --judges 2

Every fourth photo is held out from everything; each view is judged by the nearest of them (all by default), of which a
photo counts that sees at least `--pixels` of it, its pose fitted to each of the three surfaces first. Medians of 7x7
patches' correlation, means over the judges; the error of the gain: blocks of 32 x 32 pixels of the view drawn anew, the
same ones for all judges, 200 times. OUT gets views.md: a table of what lies at most 1 % behind the judge's
own map (`evaluate` counts so), and one of 3 %, as cameras are refined: sensors' depth maps differ by more than 1 %.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

SIDE, DRAWS, EVERY = 32, 200, 4     # pixels of a block; draws; of so many pixels along rows and columns one is drawn
TOLERANCES = 0.01, 0.03             # share of the depth by which a judge's own depth map may be nearer


def error_of_gain(pairs) -> float:
    """Standard deviation of the mean over `pairs` (correlations before and after, (H, W), NaN where none) of the
    difference of medians."""
    rng, told = np.random.default_rng(0), []
    numbers = np.add.outer(np.arange(pairs[0][0].shape[0]) * EVERY // SIDE * 1000,
                           np.arange(pairs[0][0].shape[1]) * EVERY // SIDE)
    parts = [[part[np.isfinite(both).all(axis=0)] for part in (*both, numbers)] for both in map(np.array, pairs)]
    blocks, numbered = np.unique(np.concatenate([part[2] for part in parts]), return_inverse=True)
    cuts = np.cumsum([len(part[2]) for part in parts])[:-1]
    for _ in range(DRAWS):
        weights = np.split(rng.multinomial(len(blocks), np.ones(len(blocks)) / len(blocks))[numbered], cuts)
        told.append([_median(after, w) - _median(before, w) for (before, after, _), w in zip(parts, weights)])
    return float(np.nanstd(np.nanmean(told, axis=1)))


def _median(values, weights) -> float:
    order = np.argsort(values)
    upto = np.cumsum(weights[order])
    return values[order][np.searchsorted(upto, upto[-1] / 2)] if upto[-1] else np.nan


def rows_of(view, given, candidates, judges, depths, device, least) -> tuple[list[tuple | None], dict]:
    """For each tolerance: number of judges, median of the pixels that they see, means of their medians for each
    candidate, gain of the last over the first, its error; `judges` are views, `depths` theirs; None where no judge sees
    `least` pixels. And the judges' poses (candidates, 4, 4), fitted to each candidate, by name."""
    from pagas_cl.app.evaluate import compare_predictions, predict_photo
    from pagas_cl.method.cameras.judge import fitted_pose
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.runtime.device import open_device

    device = open_device(device)
    photos, poses = PhotoStore(device), {}
    told: list[list] = [[] for _ in TOLERANCES]
    for judge, depth in zip(judges, depths):
        seen = [predict_photo(view, given, judge, depth, tolerance=one).pixels >= least for one in TOLERANCES]
        if any(seen):
            fitted = [fitted_pose(judge, view, one, depth, device, photos) for one in candidates]
            poses[judge.name] = np.array([one.camera.world_to_camera for one in fitted])
            for those, tolerance, counts in zip(told, TOLERANCES, seen):
                found = compare_predictions(view, candidates, fitted, depth, tolerance=tolerance)
                those.extend([found] if counts and found[0].pixels >= least else ())
    return [_row(those) if those else None for those in told], poses


def _row(told) -> tuple:
    medians = np.mean([[one.median for one in those] for those in told], axis=0)
    gain = medians[-1] - medians[0]
    pairs = [[one.correlation[::EVERY, ::EVERY] for one in (those[0], those[-1])] for those in told]
    pixels = int(np.median([those[0].pixels for those in told]))
    return len(told), pixels, *medians, gain, error_of_gain(pairs) if gain else 0.0


def keep(folder: Path, given, drawn, found, own, without, with_them, rows, poses) -> None:
    """What it takes to judge, and to try a rule, without refining anew: for each view the depth as it came, times what
    cameras ask for and refined both ways as changes in 2^-16 of that, status and parallax; cameras, poses of judges."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, results in (("without", without), ("with", with_them)):
        arrays, told = {}, {}
        for view, depth in zip(own, given if name == "without" else drawn):
            result = results[view.name]
            change = np.divide(result.depth, depth, out=np.ones_like(depth), where=depth > 0) - 1
            arrays[f"{view.stem} change"] = np.rint(change.clip(-0.49, 0.49) * 2**16).astype(np.int16)
            arrays[f"{view.stem} status"] = result.status
            arrays[f"{view.stem} parallax"] = result.parallax[::8, ::8].astype(np.float32)
            told[view.name] = {"reason": result.reason, "report": result.report}
        np.savez_compressed(folder / f"{name}.npz", **arrays)
        (folder / f"{name}.json").write_text(json.dumps(told, default=str))
    scales = None if found.depth_scales is None else [found.depth_scales.tolist(), found.depth_shifts.tolist()]
    (folder / "cameras.json").write_text(json.dumps({
        "names": [view.name for view in own], "cameras": [c.world_to_camera.tolist() for c in found.cameras],
        "scales": scales, "found": found.as_dict(), "rows": rows,
        "poses": {name: {judge: those.tolist() for judge, those in told.items()} for name, told in poses.items()},
    }, default=str))


def table(rows: dict) -> str:
    lines = ["| view | judges | pixels | input | refined, cameras as given | cameras refined first | gain | |",
             "|" + "---|" * 8]
    for name, (number, pixels, *medians, gain, error) in rows.items():
        cells = [name, number, pixels, *(f"{median:.4f}" for median in medians), f"{gain:+.4f} ± {error:.4f}",
                 ("worse", "equal", "better")[1 + int(np.sign(gain))]]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    told = np.array(list(rows.values()))
    counts = [", ".join(str((np.sign(gain) == way).sum()) for way in (1, 0, -1))
              for gain in (told[:, 3] - told[:, 2], told[:, 5])]
    means = ", ".join(f"{mean:.4f}" for mean in told[:, 2:5].mean(axis=0))
    return "\n".join([*lines, "", f"Better, equal, worse: {counts[0]} with cameras as given, {counts[1]} with refined "
                      f"ones, {(told[:, 5] < -2 * told[:, 6]).sum()} worse by more than two errors; means {means}"])


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("scene", type=Path)
    parse.add_argument("out", type=Path)
    parse.add_argument("--mesh", type=Path)
    parse.add_argument("--depth-dir", type=Path)
    parse.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parse.add_argument("--judges", type=int, default=1000, help="the nearest held-out photos of a view")
    parse.add_argument("--pixels", type=int, default=1000)
    parse.add_argument("--preset", default="balanced")
    parse.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parse.add_argument("--device")
    parse.add_argument("--workers", type=int, default=1, help="processes that judge")
    parse.add_argument("--keep", type=Path, help="a folder for depth maps, cameras and poses")
    ask = parse.parse_args()
    from cameras import refined
    from real import nearest_held, with_cameras

    from pagas_cl.config.assignments import build_config
    from pagas_cl.runtime.device import open_device

    config, device = build_config(ask.preset, ask.set), open_device(ask.device)
    views, depths, held, (own, maps), found, (moved, drawn) = with_cameras(
        ask.scene, ask.mesh, ask.depth_dir, ask.share, config, device)
    sys.stderr.write(f"{found}\n")
    names, tables, poses = [view.name for view in own], [{} for _ in TOLERANCES], {}
    without, with_them = (refined(*those, config, device, names) for those in ((own, maps), (moved, drawn)))
    if ask.keep:
        keep(ask.keep, maps, drawn, found, own, without, with_them, tables, poses)
    with ProcessPoolExecutor(ask.workers, get_context("spawn")) as pool:
        asked = []
        for view, depth, first in zip(own, maps, drawn):
            judges = nearest_held(views, held, view, ask.judges)
            asked.append(pool.submit(
                rows_of, view, depth, [first, without[view.name].depth, with_them[view.name].depth],
                [views[k] for k in judges], [depths[k] for k in judges], ask.device, ask.pixels))
        for view, future in zip(own, asked):
            told, poses[view.name] = future.result()
            for rows, row in zip(tables, told):
                rows.update({view.name: row} if row else {})
    if ask.keep:
        keep(ask.keep, maps, drawn, found, own, without, with_them, tables, poses)
    ask.out.mkdir(parents=True, exist_ok=True)
    text = "\n".join(f"Within {tolerance:.0%} of the judges' depth maps:\n\n{table(rows)}\n"
                     for tolerance, rows in zip(TOLERANCES, tables) if rows)
    (ask.out / "views.md").write_text(text)
    sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
