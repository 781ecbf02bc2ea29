"""What spending steps only on some parts of a view could gain at best.

    python tests/bench/scenes.py SCENES --data DATA
    python tests/bench/staged.py SCENES OUT.md [--names relief bar motorcycle] [--device gpu]

Tiles of 32 pixels each take their depth from a run of so many steps; the cost is the mean number of steps, without the
border that a tile would need around it (6 pixels: 1.9 times the work of a tile by itself) and without any overhead.
Beside all tiles with the same steps: the tiles that had moved most get all the steps and the others the fewest; the
same with the tiles of most texture; and every tile the number that is best by the truth, which no guess can beat.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from front import case_of

from pagas_cl.app.tradeoffs.case import loaded, score
from pagas_cl.app.tradeoffs.plan import fixed
from pagas_cl.method.splat import PhotoStore, refine_levels
from pagas_cl.runtime.device import open_device

TILE = 32


def by_tile(values: np.ndarray) -> np.ndarray:
    """Sums of an (H, W) array over its tiles, (rows, columns)."""
    rows, columns = (-(-n // TILE) for n in values.shape)
    padded = np.zeros((rows * TILE, columns * TILE))
    padded[:values.shape[0], :values.shape[1]] = values
    return padded.reshape(rows, TILE, columns, TILE).sum(axis=(1, 3))


def put_together(depths, chosen: np.ndarray) -> np.ndarray:
    """(H, W): every tile from the depth map that `chosen`, whole numbers (rows, columns), says."""
    where = np.kron(chosen, np.ones((TILE, TILE), int))[:depths[0].shape[0], :depths[0].shape[1]]
    return np.choose(where, depths)


def best_by_truth(errors, steps, budget: float) -> np.ndarray:
    """Which run each tile takes so that the total error is least at `budget` mean steps: (rows, columns).

    errors : (runs, rows, columns), summed over each tile's pixels. The least of error + price * steps, the price found
    by bisection.
    """
    steps = np.asarray(steps, float)[:, None, None]
    low, high = 0.0, errors.max()
    for _ in range(60):
        price = (low + high) / 2
        chosen = np.argmin(errors + price * steps, axis=0)
        low, high = (price, high) if steps.ravel()[chosen].mean() > budget else (low, price)
    return np.argmin(errors + high * steps, axis=0)


def most_of(guess: np.ndarray, share: float, last: int) -> np.ndarray:
    """The last run for the `share` of tiles with the largest guess, the first one for the others."""
    return np.where(guess >= np.quantile(guess, 1 - share), last, 0)


def rows_of(case, device, runs, budgets):
    """(mean steps, depth error as a share of the initial one: uniform, by movement, by texture, by truth)."""
    photos, base, case = PhotoStore(device), fixed("balanced"), replace(case, held_out=[])

    def after(steps):
        config = base.with_settings(pyramid__steps=(steps,))
        return refine_levels(case.target, case.contexts, case.initial, config, device, photos).depth

    depths = [after(n) for n in runs]
    errors = np.array([by_tile(np.where(case.truth > 0, np.abs(d - case.truth), 0)) for d in depths])
    depth_per_parallax = np.where(case.parallax > 0, case.parallax, np.inf)
    moved = by_tile(np.abs(depths[0] - case.initial) / depth_per_parallax)
    texture = by_tile(np.hypot(*np.gradient(case.target.load_image().astype(float).mean(axis=2))))
    before = score(case, case.initial)["depth"]
    for budget in budgets:
        share = (budget - runs[0]) / (runs[-1] - runs[0])
        last = len(runs) - 1
        chosen = [most_of(guess, share, last) for guess in (moved, texture)] + [best_by_truth(errors, runs, budget)]
        found = [after(budget), *(put_together(depths, c) for c in chosen)]
        yield budget, [score(case, depth)["depth"] / before for depth in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--names", nargs="*", default=("relief", "bar", "motorcycle"))
    parser.add_argument("--device")
    given = parser.parse_args()
    device, most = open_device(given.device), fixed("balanced").pyramid.steps[-1]
    runs = [max(1, round(share * most)) for share in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1)]
    lines = [str(device.info), "", "| scene | mean steps | all alike | by movement | by texture | by truth |",
             "|---|---|---|---|---|---|"]
    for name in given.names:
        case = loaded(case_of(given.scenes / name))
        for steps, errors in rows_of(case, device, runs, [runs[k] for k in (2, 4, 6)]):
            lines.append(f"| {name} | {steps} | " + " | ".join(f"{error:.4f}" for error in errors) + " |")
    given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
