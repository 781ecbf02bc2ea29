"""What the tests of the twins share: settings that meet every branch, prepared scenes, central differences."""

from __future__ import annotations

from contextlib import contextmanager
from functools import cache
from itertools import cycle, repeat

import numpy as np
from support.effects import GRADIENT_CASES
from support.random_scenes import exposed, random_scene
from twins import composite, smooth
from twins import loss as losses
from twins import photo_loss as level
from twins.level import loss_and_gradient, prepare
from twins.pairs import ALPHA_MAX
from twins.project import is_valid, project
from twins.units import depth_threshold_of, median_depth

from pagas_cl.config import Config, Loss, Pyramid, Smoothness, Solver, Splatting

# Every case says what it changes from settings that no tuning of a preset moves.
BASE = Config(splatting=Splatting(radius=1.0, depth_slices=20.0, depth_footprints=0.0),
              loss=Loss(ssim=0.2, huber=0.02, gradient_weight=True, coverage_weight=True),
              smoothness=Smoothness(kind="none", weight=0.0, texture=0.8, huber=0.1, discontinuity=1e9),
              solver=Solver(rate=0.02, damping=1e-8, final_rate=1.0, views_per_step=0), pyramid=Pyramid(steps=(60,)))
CASES = {
    "order-free": dict(),
    "order-free low-pass narrow": dict(splatting__low_pass=0.3),
    "order-free wide": dict(splatting__radius=2.0),
    "order-free no occlusion low-pass": dict(splatting__occlusion=False, splatting__low_pass=0.3),
    "alpha": dict(splatting__blend="alpha"),
    "alpha low-pass": dict(splatting__blend="alpha", splatting__low_pass=0.3, splatting__radius=1.42),
    "alpha no occlusion": dict(splatting__blend="alpha", splatting__occlusion=False),
    "alpha relative": dict(splatting__blend="alpha", splatting__depth_relative=0.01),
    "alpha normalised": dict(splatting__blend="alpha", splatting__normalize=True),
    "alpha normalised low-pass": dict(splatting__blend="alpha", splatting__normalize=True, splatting__low_pass=0.3),
    "L1 only": dict(loss__ssim=0.0),
    "SSIM only": dict(loss__ssim=1.0),
    "plain L1": dict(loss__huber=0.0),
    "wide huber": dict(loss__huber=0.2),
    "no gradient weight": dict(loss__gradient_weight=False),
    "no coverage weight": dict(loss__coverage_weight=False),
    "no weights alpha": dict(splatting__blend="alpha", loss__gradient_weight=False, loss__coverage_weight=False),
    "grey": dict(loss__grey=True),
    "grey alpha": dict(loss__grey=True, splatting__blend="alpha"),
    # radius 1 would put the four neighbours of the target's own view exactly on the radius threshold
    "target view": dict(loss__target_view=True, splatting__radius=1.42),
    **GRADIENT_CASES,
}


def prepared(seed, config, **scene):
    """Depth in units, target, contexts, State; the depth differs from the initial one, as after some steps."""
    depth, target, contexts = random_scene(seed, **scene)
    if config.loss.exposure:
        contexts = exposed(contexts)
    scene_scale = median_depth(depth)
    initial = depth / scene_scale
    state = prepare(initial, target, contexts, config, scene_scale,
                    depth_threshold_of(initial, config.splatting.depth_slices))
    rng = np.random.default_rng(seed + 1000)
    moved = initial + 0.2 * np.where(state.parallax > 0, state.parallax, 0.01) * rng.standard_normal(initial.shape)
    return np.where(initial > 0, moved, 0.0), target, contexts, state


def structure(rendered, depth, target, contexts, config, state):
    """Everything discrete about a loss: equal on both sides of a step, the loss is smooth between them. `rendered`: the
    views as they were rendered for it, in order."""
    parts = []
    for context, r in zip(contexts + [target] * config.loss.target_view, rendered, strict=True):
        photo = losses.comparable(context.image, config.loss)
        residual = r.color - photo
        parts += [r.pairs.gaussian, r.pairs.pixel, r.pairs.raw < ALPHA_MAX, r.covered, r.total < 1,
                  np.sign(residual) * (np.abs(residual) > config.loss.huber)]
    if config.smoothness.kind == "planar":
        e = smooth.second_differences(depth, is_valid(depth), state.kappa)
        parts.append((e > -config.smoothness.huber).astype(int) + (e > config.smoothness.huber))
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


@contextmanager
def participation_held(run):
    """Inside, what takes part and has no gradient is what it was in `run()`: shares, and how much of a pixel is filled.

    Views are rendered in the same order inside as by `run`.
    """
    shares, filled, seen, fills = composite.shares, composite.filled, [], []

    def key(pairs):
        return pairs.pixel * 2**32 + pairs.gaussian

    def note_shares(pairs, *rest):
        share = shares(pairs, *rest)
        seen.append(dict(zip(key(pairs).tolist(), share.tolist())))
        return share

    def note_filled(S):
        fills.append(filled(S))
        return fills[-1]

    try:
        composite.shares, composite.filled = note_shares, note_filled
        run()
        again, fills_again = cycle(seen), cycle(fills)
        composite.shares = lambda pairs, *rest: np.array([*map(next(again).get, key(pairs).tolist(), repeat(0.0))])
        composite.filled = lambda S: next(fills_again)
        yield
    finally:
        composite.shares, composite.filled = shares, filled


@contextmanager
def renders_noted():
    """A list, to which the views that are rendered inside are appended."""
    noted, plain = [], level.render

    def render(*given):
        noted.append(plain(*given))
        return noted[-1]

    try:
        level.render = render
        yield noted
    finally:
        level.render = plain


def central(f, step):
    """Derivative of f at 0 from f(+-step), f(+-2 step), error of order step^4."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


def measured_gradient(config, seed, count=24, share=3e-4, **scene):
    """Analytic and differenced N dL/dd at `count` random pixels, and how many more were too near a threshold.

    A step moves the Gaussian by `share` pixels in the view where it moves fastest.
    """
    depth, target, contexts, state = prepared(seed, config, **scene)
    _, gradient = loss_and_gradient(depth, target, contexts, config, state)
    rng = np.random.default_rng(seed)
    fastest = 1e-3 + np.max([p.valid * np.linalg.norm(p.m_d, axis=1) for p in
                             (project(depth, target.camera, c.camera,
                                      scene_scale=state.scene_scale) for c in contexts)], axis=0)
    got, want, skipped = [], [], 0
    with participation_held(lambda: loss_and_gradient(depth, target, contexts, config, state)), \
            renders_noted() as rendered:
        def loss_at(changed):
            """The loss, and everything discrete about it."""
            rendered.clear()
            value, _ = loss_and_gradient(changed, target, contexts, config, state)
            return value, structure(rendered, changed, target, contexts, config, state)

        _, here = loss_at(depth)
        for i in rng.permutation(np.flatnonzero((depth.ravel() > 0) & (gradient.ravel() != 0))):
            step = share / fastest[i]

            @cache
            def moved(by, i=i):
                other = depth.copy()
                other.ravel()[i] += by
                return loss_at(other)

            if any(moved(s * step)[1] != here for s in (-2, 2)):
                skipped += 1
                continue
            got.append(gradient.ravel()[i])
            want.append(depth.size * central(lambda by, moved=moved: moved(by)[0], step))
            if len(got) == count:
                break
    return np.array(got), np.array(want), skipped
