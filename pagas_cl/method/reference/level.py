"""Twin of splat/level: the loss and gradient of one step (method sections 3 to 6)."""

from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.method.reference import loss as losses
from pagas_cl.method.reference.composite import Rendered, composite, composite_vjp
from pagas_cl.method.reference.project import depth_per_parallax, is_valid, project
from pagas_cl.method.reference.smooth import smoothness
from pagas_cl.scene.camera import Camera, footprint, viewing_distance


@dataclass(frozen=True, eq=False)
class Photo:
    """One view as the twin sees it: camera, image (H, W, 3) float64 in 0..1, mask (H, W) bool or None, and of a
    context view the gain and offset of each channel from the target's photo, (3, 2) or None, and its first surfaces
    where they are kept, (H * W,)."""

    camera: Camera
    image: np.ndarray
    mask: np.ndarray | None = None
    exposure: np.ndarray | None = None
    z_first: np.ndarray | None = None

    @classmethod
    def from_view(cls, view) -> "Photo":
        return cls(view.camera, view.load_image() / 255.0, view.load_mask())


@dataclass(frozen=True, eq=False)
class State:
    """What stays fixed during a level. Lengths in units."""

    scene_scale: float              # scene units per device unit
    depth_threshold: float          # δ: range of the initial depth / slices
    parallax: np.ndarray            # (H, W): u; 0 where the pixel is fixed
    kappa: np.ndarray               # (H, W): d0^2 / u; 0 where u is 0
    distance: float                 # viewing distance, the unit of the paper's rate
    seen: tuple[np.ndarray, ...]    # (H', W') bool of each context view
    texture: np.ndarray             # (H, W): w_grad of the target's photo


def prepare(initial, target: Photo, contexts: list[Photo], config: Config, scene_scale: float, depth_threshold: float,
            start=None) -> State:
    """The State of a level from the views at the level's size, the run's initial depth (H, W) at that size, units,
    and the depth that the level starts from (the initial one by default)."""
    views = [project(initial, target.camera, c.camera, config.splatting.low_pass, scene_scale) for c in contexts]
    sizes = [(c.camera.width, c.camera.height) for c in contexts]
    u = depth_per_parallax(views, sizes).reshape(initial.shape)
    d0 = initial if start is None else start
    kappa = np.where(u > 0, d0**2 / np.where(u > 0, u, 1.0), 0.0)
    distance = viewing_distance([target.camera, *(c.camera for c in contexts)]) / scene_scale
    return State(scene_scale, depth_threshold, u, kappa, distance if np.isfinite(distance) else 1.0,
                 tuple(losses.seen(view, *size) for view, size in zip(views, sizes)),
                 losses.w_grad(losses.comparable(target.image, config.loss)))


def depth_threshold_in(target: Photo, context: Photo, config: Config, state: State) -> float:
    """δ_c, of the view of `context`: at least `depth_footprints` of its pixels, or a slope would hide itself."""
    floor = config.splatting.depth_footprints * footprint(target.camera, context.camera, state.scene_scale)
    return max(state.depth_threshold, floor)


def render(depth, target: Photo, context: Photo, config: Config, state: State) -> Rendered:
    """The target's Gaussians in the view of `context` (method sections 3 and 4)."""
    projected = project(depth, target.camera, context.camera, config.splatting.low_pass, state.scene_scale)
    photo = losses.comparable(context.image, config.loss)
    own = target.image
    if context.exposure is not None:        # as the context photo was exposed, clipped as a photo is
        gain, offset = context.exposure.T
        own = np.clip(gain * own + offset, 0, 1)
    colors = losses.comparable(own, config.loss)
    return composite(projected, colors.reshape(-1, colors.shape[-1]), photo, config.splatting,
                     depth_threshold_in(target, context, config, state), context.z_first)


def view_loss(depth, target: Photo, context: Photo, config: Config, state: State, seen_mask=None):
    """L_v and dL_v/dd of shape (H, W) of one view (method sections 3 to 5)."""
    rendered = render(depth, target, context, config, state)
    photo = losses.comparable(context.image, config.loss)
    value, v_color, v_coverage = losses.photometric(rendered.color, rendered.coverage, photo, config.loss, seen_mask,
                                                    context.mask)
    return value, composite_vjp(rendered, v_color, v_coverage).reshape(depth.shape)


def loss_and_gradient(depth, target: Photo, contexts: list[Photo], config: Config, state: State, views=None):
    """L = mean_v L_v + L_s, a float, and N dL/dd (H, W), N the number of target pixels; 0 where there is no surface.

    `depth` (H, W) is in units, 0 = no surface; `views` are the indices of the context views of this step, all by
    default. With `config.loss.target_view` the target's own view, which has no gradient, is one more of the mean.
    """
    photos, smooth = parts_of_loss(depth, target, contexts, config, state, views)
    return photos[0] + smooth[0], photos[1] + smooth[1]


def parts_of_loss(depth, target: Photo, contexts: list[Photo], config: Config, state: State, views=None, raised=True):
    """Value and gradient of `loss_and_gradient`, of the photos and of the smoothness by themselves; `raised`: whether
    smoothness weighs what few context views call for, or what it does before."""
    views = range(len(contexts)) if views is None else views
    parts = [view_loss(depth, target, contexts[v], config, state, state.seen[v]) for v in views]
    if config.loss.target_view:
        parts.append(view_loss(depth, target, target, config, state))
    held = config.smoothness
    held = replace(held, weight=held.weight_with(len(contexts)) if raised else held.early * held.weight)
    value, gradient = smoothness(depth, is_valid(depth), held, state.kappa, target.camera.rays(), state.texture)
    photos = tuple(sum(part[k] for part in parts) / len(parts) for k in (0, 1))
    return (float(photos[0]), depth.size * photos[1]), (float(value), depth.size * gradient)
