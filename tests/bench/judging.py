"""How well a photo that took no part is predicted through each of several surfaces, on the pixels that all predict."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pagas_cl.app.report.pictures import colored
from pagas_cl.method.cameras.judge import fitted_pose
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.view.prediction import box_sum, predict_photo, project_depth, sample_bilinear
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.check.patches import grey_of
from pagas_cl.scene.images import write_image
from pagas_cl.scene.view import View

NEAREST = 2             # views that each held-out photo is carried over to
BEHIND = 0.03           # share of its depth that a point may lie behind the held-out photo's own input depth
LEAST = 1000            # pixels of which a median says something
SIDE, EVERY, DRAWS = 32, 7, 200     # pixels of a block; of so many pixels one is drawn, so many times
AROUND, MOST = 15, 0.15             # pixels along a side of what a map averages; difference at the end of its scale
INPUT, PEER = "input", "peer"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A surface to be judged: by name of view its photo with the camera that the depth (H, W) belongs to; its costs."""

    name: str
    seen: dict[str, tuple[View, np.ndarray]]
    costs: dict = field(default_factory=dict)


def nearest(held: View, views: list[View], depth: np.ndarray) -> list[View]:
    """The views that look from where `held` does, at what it does."""
    far = float(np.median(depth[depth > 0]))
    a = held.camera

    def apart(view: View) -> float:
        b = view.camera
        moved, turned = b.center - a.center, far * (b.direction - a.direction)
        return float(np.linalg.norm(moved) + np.linalg.norm(moved + turned))

    return sorted(views, key=apart)[:NEAREST]


def judged(held: View, hidden: np.ndarray, name: str, candidates: list[Candidate], device: Device,
           photos: PhotoStore, maps: Path | None = None) -> dict[str, dict] | None:
    """Figures of each candidate in the view `name`, which the photo `held` predicts: by its pose as given or fitted to
    the surface, whichever is better. `hidden`: its own input depth, behind which it sees nothing. None where all of
    them together predict too little. `maps`: folder for pictures of where each is better than the peer, or worse."""
    poses = [[held, fitted_pose(held, *one.seen[name], hidden, device, photos)] for one in candidates]
    target = candidates[0].seen[name][0].load_image()

    def best(which: int):
        view, depth = candidates[which].seen[name]
        view = replace(view, image=target)
        found = [predict_photo(view, depth, pose, hidden, tolerance=BEHIND) for pose in poses[which]]
        place = int(np.argmax([one.median if one.pixels else -2.0 for one in found]))
        position, _ = project_depth(view.camera, poses[which][place].camera, np.asarray(depth, np.float64))
        warped, _ = sample_bilinear(grey_of(held.load_image()), position)
        return found[place].correlation, warped.astype(np.float32)

    found = side_by_side(best, range(len(candidates)))
    common = np.logical_and.reduce([np.isfinite(correlation) for correlation, _ in found])
    if np.count_nonzero(common) < LEAST:
        return None
    grey = grey_of(target)[common].astype(np.float64)
    costs = {one.name: 1 - correlation[common] for one, (correlation, _) in zip(candidates, found)}
    blocks = blocks_of(common)
    for own, cost in costs.items() if maps is not None and PEER in costs else ():
        file = f"{Path(name).stem}_{Path(held.name).stem}_{re.sub('[^a-z]+', '_', own)}.png"
        write_image(maps / file, better_and_worse(common, cost - costs[PEER]))

    def figures(which: int) -> dict:
        one, warped = candidates[which], found[which][1][common].astype(np.float64)
        cost, others = costs[one.name], [name for name in (INPUT, PEER) if name in costs and name != one.name]
        return {"cost": np.percentile(cost, (25, 50, 75)), "grey": grey_error(grey, warped),
                "covers": np.mean(one.seen[name][1] > 0), "judged": common.mean(),
                "gains": {other: gain(costs[other], cost, blocks) for other in others}}

    return dict(zip(costs, side_by_side(figures, range(len(candidates)))))


def better_and_worse(common: np.ndarray, difference: np.ndarray) -> np.ndarray:
    """A picture of the mean difference around each of the `common` pixels: blue is better, red is worse."""
    spread = np.zeros(common.shape)
    spread[common] = difference
    around, number = (np.nan_to_num(box_sum(values, AROUND)) for values in (spread, common.astype(np.float64)))
    return colored(around / np.maximum(number, 1), -MOST, MOST, common, "signed")


def blocks_of(common: np.ndarray) -> np.ndarray:
    """Number of the block that each of the `common` pixels, (H, W), lies in: blocks without any have none."""
    rows, columns = np.nonzero(common)
    return np.unique(rows // SIDE * common.shape[1] + columns // SIDE, return_inverse=True)[1]


def gain(before: np.ndarray, after: np.ndarray, blocks: np.ndarray) -> tuple[float, float]:
    """By how much the median falls, and the standard deviation of that, the blocks of pixels drawn anew."""
    rng, number = np.random.default_rng(0), blocks.max() + 1
    blocks, first, second = blocks[::EVERY], before[::EVERY], after[::EVERY]
    in_order = np.argsort(first), np.argsort(second)

    def drawn_gain(times: np.ndarray) -> float:
        """With each block so many times."""
        upto = [np.cumsum(times[blocks[order]]) for order in in_order]
        middles = [order[np.searchsorted(one, one[-1] / 2)] for order, one in zip(in_order, upto)]
        return float(first[middles[0]] - second[middles[1]])

    draws = [drawn_gain(rng.multinomial(number, np.full(number, 1 / number))) for _ in range(DRAWS)]
    return float(np.median(before) - np.median(after)), float(np.std(draws))


def grey_error(target: np.ndarray, warped: np.ndarray) -> float:
    """Median difference of grey levels after the gain and offset that fit best, outliers weighted down."""
    weight = np.ones(len(target))
    for _ in range(10):
        basis = np.stack([warped, np.ones(len(warped))], axis=1) * weight[:, None]
        gain, offset = np.linalg.lstsq(basis, target * weight, rcond=None)[0]
        left = np.abs(target - gain * warped - offset)
        weight = 1 / np.sqrt(np.maximum(left, 1.0))
    return float(np.median(left))
