"""Twin of splat/evidence: what patches of the photos say of each depth (method section 7)."""

from __future__ import annotations

import numpy as np

from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, REJECTED
from twins.loss import luma
from twins.measure import corners, patch
from twins.project import project

PATCH, WINDOW, LEAST_PIXELS, NOISE, LEAST_POSSIBLE = 2, 7, 6, 1 / 255, 0.3
BINS = 1024         # of 1 - correlation, from 0 to 2
CHANCE = 0.02       # growth of it in a photo, mean around a pixel, that says nothing


def warped(depth, target, context, z_first, depth_threshold, scene_scale):
    """The context photo seen from the target: grey value, its slope by the depth, and where they are defined.

    Parameters
    ----------
    depth : ndarray of shape (H, W), units
    target, context : Photo
    z_first : ndarray of shape (H', W')
        Nearest depth of each context pixel, inf where there is none.
    depth_threshold, scene_scale : float
        Depth threshold in units; scene units per device unit.
    """
    p = project(depth, target.camera, context.camera, 0.0, scene_scale)
    photo, (height, width) = luma(context.image), context.image.shape[:2]
    u, v = (p.m - 0.5).T
    inside = p.valid & (u >= 0) & (v >= 0) & (u <= width - 1.001) & (v <= height - 1.001)
    near = z_first[tuple(np.floor(np.where(inside, at, 0) + 0.5).astype(int) for at in (v, u))]
    inside &= p.z <= near + depth_threshold
    (g00, g10, g01, g11), a, b, inside = corners(photo, context.mask, u, v, inside)
    value = (1 - b) * ((1 - a) * g00 + a * g10) + b * ((1 - a) * g01 + a * g11)
    slope = (((1 - b) * (g10 - g00) + b * (g11 - g01)) * p.m_d[:, 0]
             + ((1 - a) * (g01 - g00) + a * (g11 - g10)) * p.m_d[:, 1])
    return value.reshape(depth.shape), slope.reshape(depth.shape), inside.reshape(depth.shape)


def weigh(value, slope, inside, own, noise_variance: float = 0.0):
    """1 - correlation of 5x5 patches, the information on the depth (1 / variance), and where both are defined.

    Parameters
    ----------
    value, slope, inside : ndarray of shape (H, W)
        From `warped`.
    own : ndarray of shape (H, W)
        Grey of the target's photo.
    noise_variance : float
        Variance of the photos' noise beyond NOISE.
    """
    n = _patch_sum(inside.astype(float))
    mean = lambda x: _patch_sum(np.where(inside, x, 0.0)) / np.maximum(n, 1)   # noqa: E731
    mw, mt, ms = mean(value), mean(own), mean(slope)
    var_w, var_t = mean(value**2) - mw**2, mean(own**2) - mt**2
    noise = NOISE**2
    flat, cov = max(noise - noise_variance, 1e-9), mean(value * own) - mw * mt
    variances = [np.maximum(v, 0) + flat for v in (var_w, var_t)]
    possible = np.sqrt(np.maximum(1 - 4 / 9 * noise_variance / variances[0], 0)
                       * np.maximum(1 - noise_variance / variances[1], 0))
    correlation = (cov + flat) / np.sqrt(variances[0] * variances[1]) / np.maximum(possible, LEAST_POSSIBLE)
    product = np.maximum(var_w, 0) * np.maximum(var_t, 0)
    explained = np.minimum(np.clip(cov, 0, None) ** 2 / np.maximum(product, noise**2), 1)
    unexplained = np.maximum(var_w, 0) * (1 - explained) + noise
    information = explained * np.maximum(n * (mean(slope**2) - ms**2), 0) / unexplained
    return 1 - correlation, information, inside & (n >= LEAST_PIXELS)


def decide(initial, refined, depth_per_parallax, before, after, max_move, tolerance, mismatch):
    """Status of each depth: 0 no surface, 1 refined, 2 kept, 3 rejected.

    Parameters
    ----------
    initial, refined, depth_per_parallax : ndarray of shape (H, W)
    before, after : ndarray of shape (H, W, 3)
        Sum of 1 - correlation, views, information.
    max_move, tolerance, mismatch : float
        See config.Solver.
    """
    cost, views = (_patch_sum(after[..., k], WINDOW) for k in (0, 1))
    seen_twice = before[..., 1] * after[..., 1]
    worse = after[..., 0] * before[..., 1] > before[..., 0] * after[..., 1] + tolerance * seen_twice
    refused = (~(np.abs(refined - initial) <= max_move * depth_per_parallax) | worse & (before[..., 1] > 0)
               | (cost > mismatch * views))
    unseen = (depth_per_parallax == 0) | (after[..., 1] == 0)
    return np.select([~(initial > 0), unseen, refused], [NO_SURFACE, KEPT, REJECTED], REFINED)


def costs(before, after):
    """1 - correlation before and after, NaN where no view sees a pixel, and where views see it both times.

    Parameters
    ----------
    before, after : ndarray of shape (..., 3)
        Sum of 1 - correlation, views, information.

    Returns
    -------
    was, now, known : ndarray of shape (...)
    """
    was, now = (np.where(e[..., 1] > 0, e[..., 0] / np.maximum(e[..., 1], 1), np.nan) for e in (before, after))
    return was, now, (before[..., 1] > 0) & (after[..., 1] > 0)


def mean_costs(before, after) -> tuple[float, float]:
    """Mean 1 - correlation before and after over the pixels that are seen both times; NaN without any."""
    was, now, known = costs(before, after)
    return (float(was[known].mean()), float(now[known].mean())) if known.any() else (np.nan, np.nan)


def counted_costs(before, after) -> np.ndarray:
    """How often each 1 - correlation occurs before and after over the pixels that are seen both times: shape (2, BINS),
    what lies outside 0 to 2 in the first and the last bin."""
    was, now, known = costs(before, after)
    place = np.clip(np.floor(np.stack([was[known], now[known]]) * (BINS / 2)), 0, BINS - 1).astype(int)
    return np.stack([np.bincount(row, minlength=BINS) for row in place])


def worse(before, after) -> np.ndarray:
    """By how much 1 - correlation grew beyond chance, of the shape of a map; 0 where it is not known."""
    was, now, known = costs(before, after)
    return np.where(known, now - was - CHANCE, 0.0)


def refuse(status, growth):
    """Status of shape (H, W) after what a held-out photo speaks against was rejected.

    Parameters
    ----------
    status : ndarray of shape (H, W)
        As `decide` leaves it.
    growth : ndarray of shape (H, W)
        `worse` of the held-out view's evidence. Summed over the surroundings twice, so that nearer pixels count
        for more.
    """
    around = _patch_sum(_patch_sum(growth, WINDOW), WINDOW)
    return np.where((status == REFINED) & (around > 0), REJECTED, status)


def feather(initial, refined, status):
    """Depths accepted: rejected ones go back, refined ones move less towards those, over 7x7 pixels."""
    judged = _patch_sum(np.isin(status, (REFINED, REJECTED)) * 1.0, 3)
    share = _patch_sum((status == REFINED) * 1.0, 3) / np.maximum(judged, 1)
    moved = initial + np.clip(2 * share - 1, 0, 1) * (refined - initial)
    return np.where(status == REFINED, moved, initial)


def hold_uninformative(initial, refined, status, deviation):
    """Depths and status after refined ones that no photo speaks for went back by how few around them, over 15x15
    pixels, have one that does, of 60; those without any are kept."""
    informative = (status == REFINED) & np.isfinite(deviation)
    share = np.minimum(_patch_sum(informative * 1.0, WINDOW) / 60, 1)
    moved = np.where((status == REFINED) & ~informative, initial + share * (refined - initial), refined)
    return moved, np.where((status == REFINED) & ~informative & (moved == initial), KEPT, status)


def deviation(depth, status, depth_per_parallax, before, after, error_factor: float, misaligned: float,
              mismatch: float):
    """Standard deviation of each depth of shape (H, W), units; infinite where nothing is known.

    Parameters
    ----------
    depth, status, depth_per_parallax, before, after
        Accepted depth, and as in `decide`.
    error_factor, misaligned, mismatch : float
        See Measurements, and as in `decide`.
    """
    held = np.where((status == REFINED)[..., None], after, before)
    bending = 0.35 * _patch_sum(bends(depth, depth_per_parallax)) / _patch_sum(np.ones_like(depth))
    with np.errstate(divide="ignore", invalid="ignore"):
        match = 0.7 / held[..., 2] + depth_per_parallax**2 * (bending**2 + 0.02**2)
        total = np.sqrt(error_factor**2 * match + depth_per_parallax**2 * 0.36 * misaligned**2 / held[..., 1])
    known = (held[..., 1] > 0) & (held[..., 2] > 0) & ~(
        (status == REJECTED) & (held[..., 0] > mismatch * held[..., 1]))
    return np.where(status == NO_SURFACE, 0.0, np.where(known, total, np.inf))


def bends(depth, depth_per_parallax, most: float = 1.4):
    """Second differences of inverse depth along both directions, pixels of parallax, added; at most `most`, which also
    stands where a neighbour has no depth."""
    total = np.zeros_like(depth)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan)
        kappa = np.where(depth_per_parallax > 0, depth**2 / depth_per_parallax, np.nan)
    for axis in (0, 1):
        inner = np.s_[1:-1] if axis == 0 else np.s_[:, 1:-1]
        total[inner] += np.nan_to_num(np.abs(np.diff(inverse, 2, axis=axis)) * kappa[inner], nan=most)
    return np.where((depth > 0) & (depth_per_parallax > 0), np.minimum(total, most), 0.0)


def _patch_sum(image: np.ndarray, half: int = PATCH) -> np.ndarray:
    return sum(patch(image, half))
