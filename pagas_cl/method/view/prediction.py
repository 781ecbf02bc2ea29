"""How well a depth map predicts a photo that took no part: correlation of patches warped through the depth."""

from dataclasses import dataclass, field

import numpy as np

from pagas_cl.scene.check.patches import grey_of
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.inputs import check_maps

PATCH = 7          # pixels along a side of the patches that are correlated


@dataclass(frozen=True, eq=False)
class Prediction:
    """Zero-mean normalised cross-correlation of the target's patches with those warped from a held-out photo.

    `median` and `mean` are over the `pixels` whose whole patch is seen in both photos and has contrast in the target;
    `correlation`: per pixel, float32 (H, W), nan where it is not defined.
    """

    median: float
    mean: float
    pixels: int
    correlation: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, correlation: np.ndarray) -> "Prediction":
        """Figures of a map of correlations."""
        values = correlation[np.isfinite(correlation)]
        if not len(values):
            return cls(float("nan"), float("nan"), 0, correlation)
        return cls(float(np.median(values)), float(values.mean()), len(values), correlation)


def predict_photo(target, depth, other, other_depth=None, tolerance: float = 0.01) -> Prediction:
    """Warp the photo of the View `other` into `target` through its z-depth (H, W), 0 = no surface, and correlate.

    Pixels that lie behind `other_depth`, of the other photo's size, by more than `tolerance` (share of the depth) are
    not seen there and left out; without it the target's own points occlude one another.
    """
    depth = sized(depth, target.camera, f"depth map of {target.name!r}")
    position, z = project_depth(target.camera, other.camera, depth)
    warped, inside = sample_bilinear(grey_of(other.load_image()), position)
    seen = inside & (depth > 0) & (z > 0)
    seen &= _visible(position, z, seen, other, other_depth, tolerance)
    keep, other_keep = target.load_mask(), other.load_mask()
    if keep is not None:
        seen &= keep
    if other_keep is not None:
        seen &= sample_bilinear(other_keep.astype(np.float32), position)[0] > 0.999
    return Prediction.of(correlate(grey_of(target.load_image()), warped, seen))


def compare_predictions(target, depths, other, other_depth=None, tolerance: float = 0.01) -> list[Prediction]:
    """`predict_photo` for several depth maps over the pixels that all predict: none gains by leaving some out. `other`:
    a view, or several (the same photo, its pose fitted to each depth map: cameras.judge.fitted_pose), of which each
    depth map is judged under the one that predicts it best, since a fit may end off the best pose."""
    others = other if isinstance(other, (list, tuple)) else [other]
    others = [view for k, view in enumerate(others) if all(view is not earlier for earlier in others[:k])]
    each = [[predict_photo(target, depth, view, other_depth, tolerance) for view in others] for depth in depths]
    maps = [max(of_map, key=lambda one: _worth(one, of_map)).correlation for of_map in each]
    common = np.logical_and.reduce([np.isfinite(m) for m in maps])
    return [Prediction.of(np.where(common, m, np.nan).astype(np.float32)) for m in maps]


def _worth(one: Prediction, others: list[Prediction]) -> float:
    """Median of `one` of several; -2 where it sees much less than another."""
    return one.median if one.pixels and one.pixels > 0.8 * max(other.pixels for other in others) else -2.0


def project_depth(camera, other, depth) -> tuple[np.ndarray, np.ndarray]:
    """Where `other` sees the points of a depth map (H, W) of `camera`: pixel positions (H, W, 2) and z there (H, W)."""
    rotation, tau = other.relative_to(camera)
    rays = camera.rays()
    x, y, z = (depth * (rays @ row) + shift for row, shift in zip(rotation, tau))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([x / z * other.fx + other.cx, y / z * other.fy + other.cy], axis=-1), z


def sized(depth, camera, what) -> np.ndarray:
    """A depth map as float64; InputError where it has not the camera's size."""
    depth = np.asarray(depth, np.float64)
    check_maps([camera], [depth], what)
    return depth


def correlate(a, b, valid) -> np.ndarray:
    """Zero-mean normalised cross-correlation of two grey images (0..255) in windows, float32 (H, W). Nan where the
    window leaves the image, holds an invalid pixel, or deviates by less than half a grey level."""
    a, b = np.asarray(a, np.float64), np.where(valid, b, 0.0)
    number = PATCH * PATCH
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = box_sum(valid.astype(np.float64), PATCH) > number - 0.5
        mean_a, mean_b = box_sum(a, PATCH) / number, box_sum(b, PATCH) / number
        var_a = box_sum(a * a, PATCH) / number - mean_a**2
        var_b = box_sum(b * b, PATCH) / number - mean_b**2
        score = (box_sum(a * b, PATCH) / number - mean_a * mean_b) / np.sqrt(np.maximum(var_a * var_b, 1e-12))
    # a warped patch without contrast predicts nothing: it counts as 0, or a wrong depth could gain by finding one
    score = np.where(var_b < 0.25, 0.0, score)
    return np.where(whole & (var_a >= 0.25), np.clip(score, -1, 1), np.nan).astype(np.float32)


def box_sum(image, size) -> np.ndarray:
    """Sums over size x size windows, nan where the window leaves the image: float64 (H, W)."""
    out = np.full(image.shape, np.nan)
    h, w = image.shape
    if min(h, w) < size:
        return out
    half, image = size // 2, np.asarray(image, np.float64)
    across = sum(image[:, k:w - size + 1 + k] for k in range(size))
    out[half:h - half, half:w - half] = sum(across[k:h - size + 1 + k] for k in range(size))
    return out


def sample_bilinear(image, position):
    """Values at pixel positions (..., 2), pixel centres at +0.5, and whether each lies between four centres."""
    h, w = image.shape
    x, y = np.moveaxis(position, -1, 0)
    with np.errstate(invalid="ignore"):
        inside = (x >= 0.5) & (y >= 0.5) & (x <= w - 0.5) & (y <= h - 0.5)
    return np.where(inside, bilinear(image, x, y), 0.0), inside


def _visible(position, z, seen, other, other_depth, tolerance):
    """Which points nothing hides in the other view."""
    h, w = other.camera.height, other.camera.width
    column = np.clip(np.nan_to_num(position[..., 0]), 0, w - 1).astype(np.int64)
    row = np.clip(np.nan_to_num(position[..., 1]), 0, h - 1).astype(np.int64)
    if other_depth is None:
        first = np.full((h, w), np.inf)
        np.minimum.at(first, (row[seen], column[seen]), z[seen])
    else:
        first = sized(other_depth, other.camera, f"depth map of {other.name!r}")
        first = np.where(first > 0, first, np.inf)
    return z <= first[row, column] * (1 + tolerance)
