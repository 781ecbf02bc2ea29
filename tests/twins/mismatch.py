"""Twin of mismatch.cl: how a surface bends, and what photos leave open about its depth (method section 5.2)."""

from __future__ import annotations

import numpy as np

from pagas_cl.reference.loss import luma
from pagas_cl.reference.project import project

NEAR_BY, PATCH, LEAST_PIXELS, NOISE, CONFIRMED = 4, 2, 20, 1 / 255, 0.25


def bends(depth, kappa, at, step: int):
    """|second difference| of inverse depth over `step` pixels, across and down, at `at`, (rows, columns); or NaN."""
    found, (height, width) = [], depth.shape
    for dv, du in ((0, step), (step, 0)):
        v, u = at
        inside = (v >= dv) & (u >= du) & (v < height - dv) & (u < width - du)
        ends = [depth[np.clip(v + s * dv, 0, height - 1), np.clip(u + s * du, 0, width - 1)] for s in (-1, 1)]
        with np.errstate(divide="ignore", invalid="ignore"):
            bend = kappa[at] * np.abs(1 / ends[0] + 1 / ends[1] - 2 / depth[at])
        good = inside & (depth[at] > 0) & (ends[0] > 0) & (ends[1] > 0) & (bend > 0)
        found.append(np.where(good, bend, np.nan))
    return found


def match(depth, parallax, target, context, scene_scale, at):
    """Variance of the depth, squared pixels of parallax, by one patch of the context photo; NaN where it tells none.
    `target`, `context`: Photo."""
    values = []
    for shift in (0.0, -0.5, 0.5):
        p = project(depth + shift * parallax, target.camera, context.camera, 0.0, scene_scale)
        u, v = (p.m - 0.5).T
        height, width = context.image.shape[:2]
        inside = p.valid & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        x, y = (np.clip(np.floor(np.where(inside, c, 0)).astype(int), 0, n - 2) for c, n in ((u, width), (v, height)))
        photo, a, b = luma(context.image), u - x, v - y
        grey = ((1 - b) * ((1 - a) * photo[y, x] + a * photo[y, x + 1])
                + b * ((1 - a) * photo[y + 1, x] + a * photo[y + 1, x + 1]))
        values.append(np.where(inside, grey, np.nan).reshape(depth.shape))
    own, seen, out = luma(target.image), np.isfinite(sum(values)) & (parallax > 0) & (depth > 0), []
    for v, u in zip(*at):
        window = np.s_[max(v - PATCH, 0):v + PATCH + 1, max(u - PATCH, 0):u + PATCH + 1]
        use = seen[window]
        w, t, s = (x[window][use] for x in (values[0], own, values[2] - values[1]))
        if len(w) < LEAST_PIXELS:
            out.append(np.nan)
            continue
        cov = max(np.mean(w * t) - w.mean() * t.mean(), 0)
        explained = min(cov**2 / max(w.var() * t.var(), NOISE**4), 1)
        slopes = len(w) * s.var()
        good = explained > CONFIRMED and slopes > 0
        out.append((w.var() * (1 - explained) + NOISE**2) / (explained * slopes) if good else np.nan)
    return np.array(out)
