"""Real photos, view by view: held-out photos through the input, refined depth, and refined depth with refined cameras.

    python tests/bench/by_view.py hololens_rgbd [--json FILE]
    python tests/bench/by_view.py dtu_scan24 --mesh dtu_scan24/derived/mesh_coarse.ply --share 0.5 --judges 2

Every fourth photo is held out from everything; each view is judged by the nearest of them (all by default), of which a
photo counts that sees at least `--pixels` of it, its pose fitted to each of the three surfaces first. Medians of 7x7
patches' correlation, means over the judges; the error of the gain: blocks of 32 x 32 pixels of the view drawn anew, the
same ones for all judges, 200 times. Points count that lie at most 1 % behind the
judge's own map (as `evaluate` has it), or 3 %, as cameras are refined: sensors' depth maps differ by more than 1 %.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from record import add_json, record

MEASURED = ("Every fourth photo is held out from everything and judges, its pose fitted to each surface first: mean "
            "over the judges of the median correlation through the input, the depth refined with the cameras as given, "
            "and with cameras refined first; the gain of the last over the input with its standard deviation; "
            "`within`: by how much a point may lie behind the judge's own depth map.")
SIDE = 32               # pixels of a block
DRAWS = 200
EVERY = 4               # of so many pixels along rows and columns one is drawn
TOLERANCES = 0.01, 0.03             # share of the depth by which a judge's own depth map may be nearer


def error_of_gain(pairs) -> float:
    """Standard deviation of the mean over `pairs` (correlations before and after, (H, W), NaN where none) of the
    difference of medians."""
    rng, draws = np.random.default_rng(0), []
    numbers = np.add.outer(np.arange(pairs[0][0].shape[0]) * EVERY // SIDE * 1000,
                           np.arange(pairs[0][0].shape[1]) * EVERY // SIDE)
    parts = [[part[np.isfinite(both).all(axis=0)] for part in (*both, numbers)] for both in map(np.array, pairs)]
    blocks, numbered = np.unique(np.concatenate([part[2] for part in parts]), return_inverse=True)
    cuts = np.cumsum([len(part[2]) for part in parts])[:-1]
    for _ in range(DRAWS):
        weights = np.split(rng.multinomial(len(blocks), np.ones(len(blocks)) / len(blocks))[numbered], cuts)
        draws.append([_median(after, w) - _median(before, w) for (before, after, _), w in zip(parts, weights)])
    return float(np.nanstd(np.nanmean(draws, axis=1)))


def _median(values, weights) -> float:
    order = np.argsort(values)
    upto = np.cumsum(weights[order])
    return values[order][np.searchsorted(upto, upto[-1] / 2)] if upto[-1] else np.nan


def rows_of(view, given, candidates, judges, depths, device, least) -> list[tuple | None]:
    """For each tolerance: number of judges, median of the pixels that they see, means of their medians for each
    candidate, gain of the last over the first, its error; `judges` are views, `depths` theirs; None where no judge sees
    `least` pixels."""
    from pagas_cl.app.evaluate import compare_predictions, predict_photo
    from pagas_cl.method.cameras.judge import fitted_pose
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.runtime.device import open_device

    device = open_device(device)
    photos = PhotoStore(device)
    found_of: list[list] = [[] for _ in TOLERANCES]
    for judge, depth in zip(judges, depths):
        seen = [predict_photo(view, given, judge, depth, tolerance=one).pixels >= least for one in TOLERANCES]
        if any(seen):
            fitted = [fitted_pose(judge, view, one, depth, device, photos) for one in candidates]
            for those, tolerance, counts in zip(found_of, TOLERANCES, seen):
                found = compare_predictions(view, candidates, fitted, depth, tolerance=tolerance)
                those.extend([found] if counts and found[0].pixels >= least else ())
    return [_row(those) if those else None for those in found_of]


def _row(found) -> tuple:
    medians = np.mean([[one.median for one in those] for those in found], axis=0)
    gain = medians[-1] - medians[0]
    pairs = [[one.correlation[::EVERY, ::EVERY] for one in (those[0], those[-1])] for those in found]
    pixels = int(np.median([those[0].pixels for those in found]))
    return len(found), pixels, *medians, gain, error_of_gain(pairs) if gain else 0.0


def shown(name: str, tolerance: float, row: tuple) -> dict:
    """The row of a view in the table."""
    number, pixels, first, without, with_them, gain, error = row
    return {"within": f"{tolerance:.0%}", "view": name, "judges": number, "pixels": pixels, "input": f"{first:.4f}",
            "refined, cameras as given": f"{without:.4f}", "cameras refined first": f"{with_them:.4f}",
            "gain": f"{gain:+.4f} ± {error:.4f}", "prediction": ("worse", "equal", "better")[1 + int(np.sign(gain))]}


def summary(tolerance: float, rows: list[tuple]) -> dict:
    """Means and counts over the views: better, equal, worse."""
    values = np.array(rows)
    without, gains = values[:, 3] - values[:, 2], values[:, 5]
    counts = [", ".join(str((np.sign(gain) == sign).sum()) for sign in (1, 0, -1)) for gain in (without, gains)]
    means = [f"{mean:.4f}" for mean in values[:, 2:5].mean(axis=0)]
    return {"within": f"{tolerance:.0%}", "view": f"all {len(rows)}", "input": means[0],
            "refined, cameras as given": f"{means[1]}: {counts[0]}",
            "cameras refined first": f"{means[2]}: {counts[1]}", "gain": f"{gains.mean():+.4f}",
            "prediction": f"{(gains < -2 * values[:, 6]).sum()} worse by two errors"}


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("scene", type=Path)
    parse.add_argument("--mesh", type=Path)
    parse.add_argument("--depth-dir", type=Path)
    parse.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parse.add_argument("--judges", type=int, default=1000, help="the nearest held-out photos of a view")
    parse.add_argument("--pixels", type=int, default=1000)
    parse.add_argument("--preset", default="balanced")
    parse.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parse.add_argument("--device")
    parse.add_argument("--workers", type=int, default=1, help="processes that judge")
    add_json(parse)
    options = parse.parse_args()
    from cameras import refined
    from real import nearest_held, with_cameras

    from pagas_cl.config.assignments import build_config
    from pagas_cl.runtime.device import open_device

    config, device = build_config(options.preset, options.set), open_device(options.device)
    views, depths, held, (own, maps), found, (moved, drawn) = with_cameras(
        options.scene, options.mesh, options.depth_dir, options.share, config, device)
    sys.stderr.write(f"{found}\n")
    names = [view.name for view in own]
    without, with_them = (refined(*those, config, device, names) for those in ((own, maps), (moved, drawn)))
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        pending = []
        for view, depth, first in zip(own, maps, drawn):
            judges = nearest_held(views, held, view, options.judges)
            pending.append(pool.submit(
                rows_of, view, depth, [first, without[view.name].depth, with_them[view.name].depth],
                [views[k] for k in judges], [depths[k] for k in judges], options.device, options.pixels))
        of_views = [future.result() for future in pending]
    rows = []
    for k, tolerance in enumerate(TOLERANCES):
        judged = {name: found[k] for name, found in zip(names, of_views) if found[k] is not None}
        rows += [shown(name, tolerance, row) for name, row in judged.items()]
        rows += [summary(tolerance, list(judged.values()))] * bool(judged)
    record(f"Real photos, cameras refined first: {options.scene.name}", MEASURED, device.info.title, rows, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
