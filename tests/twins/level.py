"""Twin of splat/level: the loss of a step with its smoothness, the steps of a level, and a whole small refinement
(method section 6)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.scene.camera import viewing_distance
from twins import loss as losses
from twins import resample
from twins.carry_over import carry_over
from twins.gradient_filter import filter_gradient
from twins.pairs import candidates, nearest_surface
from twins.photo_loss import Photo, State, photo_loss, state_of
from twins.project import Projected, is_valid, project
from twins.smooth import smoothness
from twins.step import Adam, Plateau, late_share
from twins.units import depth_threshold_of, median_depth

MOST_MOVED = 0.5         # pixels of parallax that depths may move by before the first surfaces are looked for again


@dataclass(frozen=True, eq=False)
class LevelState(State):
    """What stays fixed during a level, what a step and its smoothness take included. Lengths in units."""

    parallax: np.ndarray            # (H, W): u; 0 where the pixel is fixed
    kappa: np.ndarray               # (H, W): d0^2 / u; 0 where u is 0
    distance: float                 # viewing distance, the unit of the paper's rate
    texture: np.ndarray             # (H, W): w_grad of the target's photo


@dataclass(frozen=True, eq=False)
class Refined:
    """depth (H, W) float64 in scene units, 0 = no surface; the loss of every step; steps of every level."""

    depth: np.ndarray
    losses: list[float]
    steps: list[int]


def prepare(initial, target: Photo, contexts: list[Photo], config: Config, scene_scale: float, depth_threshold: float,
            start=None) -> LevelState:
    """The state of a level from the views at the level's size, the run's initial depth (H, W) at that size, units,
    and the depth that the level starts from (the initial one by default)."""
    views = [project(initial, target.camera, c.camera, config.splatting.low_pass, scene_scale) for c in contexts]
    sizes = [(c.camera.width, c.camera.height) for c in contexts]
    u = depth_per_parallax(views, sizes).reshape(initial.shape)
    d0 = initial if start is None else start
    kappa = np.where(u > 0, d0**2 / np.where(u > 0, u, 1.0), 0.0)
    distance = viewing_distance([target.camera, *(c.camera for c in contexts)]) / scene_scale
    photos = state_of(initial, target, contexts, config, scene_scale, depth_threshold)
    return LevelState(scene_scale, depth_threshold, photos.seen, u, kappa, distance if np.isfinite(distance) else 1.0,
                      losses.w_grad(losses.comparable(target.image, config.loss)))


def depth_per_parallax(projections: list[Projected], sizes: list[tuple[int, int]]) -> np.ndarray:
    """u of shape (N,): the change of depth that moves the projected mean by one pixel, root mean square over views.

    u = 1 / sqrt(mean_v |dm/dd|^2) over the context views where z > near and m is inside the image, `sizes` being
    their (width, height); 0 where there is none, or none with parallax (the pixel is fixed).
    """
    total, count = 0.0, 0
    for projected, size in zip(projections, sizes):
        inside = projected.valid & ((projected.m >= 0) & (projected.m < size)).all(axis=1)
        total = total + inside * (projected.m_d**2).sum(axis=1)
        count = count + inside
    total = np.asarray(total, np.float64)
    return np.where(total > 0, np.sqrt(count / np.where(total > 0, total, 1.0)), 0.0)


def loss_and_gradient(depth, target: Photo, contexts: list[Photo], config: Config, state: LevelState, views=None):
    """L = mean_v L_v + L_s, a float, and N dL/dd (H, W): as photo_loss, with the smoothness."""
    photos, smooth = parts_of_loss(depth, target, contexts, config, state, views)
    return photos[0] + smooth[0], photos[1] + smooth[1]


def parts_of_loss(depth, target: Photo, contexts: list[Photo], config: Config, state: LevelState, views=None,
                  raised=True):
    """Value and gradient of `loss_and_gradient`, of the photos and of the smoothness by themselves; `raised`: whether
    smoothness weighs what few context views need, or what it does before."""
    held = config.smoothness
    held = replace(held, weight=held.weight_with(len(contexts)) if raised else held.early * held.weight)
    value, gradient = smoothness(depth, is_valid(depth), held, state.kappa, target.camera.rays(), state.texture)
    return photo_loss(depth, target, contexts, config, state, views), (float(value), depth.size * gradient)


def resized(photo: Photo, scale: float) -> Photo:
    """The view at a pyramid level."""
    size = resample.scaled_size(photo.camera.width, photo.camera.height, scale)
    mask = None if photo.mask is None else resample.shrink_mask(photo.mask, *size)
    return Photo(photo.camera.resized(*size), resample.shrink_image(photo.image, *size), mask, photo.exposure)


def views_of_step(step: int, number: int, per_step: int) -> list[int]:
    """Context views of step 0, 1, ...: `per_step` of them in turn, or all."""
    if per_step <= 0 or per_step >= number:
        return list(range(number))
    return [(step * per_step + i) % number for i in range(per_step)]


def first_surfaces(depth, target: Photo, context: Photo, config: Config, state: LevelState) -> np.ndarray:
    """The first surface in each pixel of the view of `context`, (H * W,)."""
    size = context.camera.width, context.camera.height
    projected = project(depth, target.camera, context.camera, config.splatting.low_pass, state.scene_scale)
    return nearest_surface(candidates(projected, *size, config.splatting), size[0] * size[1])


def run_level(depth, target: Photo, contexts: list[Photo], config: Config, state: LevelState, steps: int):
    """Adam on one level: the depth in units after at most `steps` steps, and the loss before each of them."""
    solver, history = config.solver, []
    length = state.parallax if solver.rate_unit == "parallax" else np.where(state.parallax > 0, state.distance, 0.0)
    adam = Adam.start(depth.shape, solver.beta1, solver.beta2)
    schedule = Plateau(solver.rate, solver.patience, solver.rate_floor)
    contexts, moved = list(contexts), [np.inf] * len(contexts)
    a_step = len(views_of_step(0, len(contexts), solver.views_per_step))
    keeps = (config.splatting.blend == "order_free" and config.splatting.occlusion
             and solver.rate_unit == "parallax" and len(contexts) * solver.rate <= a_step * MOST_MOVED)
    for step in range(steps):
        views = views_of_step(step, len(contexts), solver.views_per_step)
        for view in [v for v in views if keeps and moved[v] > MOST_MOVED]:
            moved[view] = 0.0
            first = first_surfaces(depth, target, contexts[view], config, state)
            contexts[view] = replace(contexts[view], z_first=first)
        photos, smooth = parts_of_loss(depth, target, contexts, config, state, views,
                                       raised=step >= solver.raised_from(steps))
        filtered = filter_gradient(photos[1], state.parallax, solver.gradient_filter)
        value, gradient = photos[0] + smooth[0], filtered + smooth[1]
        history.append(value)
        rate = schedule.next_rate(value)
        if rate == 0:
            break
        share = late_share(step, steps, solver.final_rate)
        depth = adam.step(depth, gradient, length, rate * share, solver.damping_at(step, steps))
        moved = [pixels + solver.rate * share for pixels in moved]
    return depth, history


def refine(depth, target: Photo, contexts: list[Photo], config: Config) -> Refined:
    """Refine a depth map (H, W) in scene units, 0 = no surface: every level of the pyramid (method section 6).

    Pixels that moved by more than `solver.max_move` pixels of parallax get their input back.
    """
    valid = is_valid(depth) if target.mask is None else is_valid(depth) & target.mask
    scene_scale = median_depth(np.where(valid, depth, 0.0))
    initial = np.where(valid, depth, 0.0) / scene_scale
    depth_threshold = depth_threshold_of(initial, config.splatting.depth_slices)
    before, current, history, counts = None, None, [], []
    for scale, steps in zip(config.pyramid.scales, config.pyramid.steps):
        level_target, level_contexts = resized(target, scale), [resized(c, scale) for c in contexts]
        size = level_target.camera.width, level_target.camera.height
        level_initial = resample.shrink_depth(initial, *size)
        if before is None:
            finer = level_initial
        elif config.pyramid.carry_over:
            finer = carry_over(level_initial, before[0], current, before[1], 0.0, 0.0)
        else:
            finer = resample.enlarge_depth(current, *size)
        start = np.where((level_initial > 0) & (finer > 0), finer, level_initial)
        state = prepare(level_initial, level_target, level_contexts, config, scene_scale, depth_threshold, start)
        current, values = run_level(start, level_target, level_contexts, config, state, steps)
        before = level_initial, state.parallax
        history += values
        counts.append(len(values))
    kept = (current == initial) | (np.abs(current - initial) > config.solver.max_move * state.parallax)
    return Refined(np.where(valid, np.where(kept, depth, current * scene_scale), 0.0), history, counts)
