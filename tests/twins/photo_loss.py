"""Twin of splat/level: what the photos say in one step, loss and gradient (method sections 3 to 5)."""

from dataclasses import dataclass

import numpy as np

from pagas_cl.config import Config
from pagas_cl.scene.camera import Camera, footprint
from twins import loss as losses
from twins.composite import Rendered, composite, composite_vjp
from twins.project import project


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
    seen: tuple[np.ndarray, ...]    # (H', W') bool of each context view


def state_of(initial, target: Photo, contexts: list[Photo], config: Config, scene_scale: float,
             depth_threshold: float) -> State:
    """The State of a level from the views and the run's initial depth (H, W), units, both at the level's size."""
    views = [project(initial, target.camera, c.camera, config.splatting.low_pass, scene_scale) for c in contexts]
    seen = tuple(losses.seen(view, c.camera.width, c.camera.height) for view, c in zip(views, contexts))
    return State(scene_scale, depth_threshold, seen)


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


def photo_loss(depth, target: Photo, contexts: list[Photo], config: Config, state: State, views=None):
    """mean_v L_v, a float, and N times its gradient (H, W), N the number of target pixels; 0 where there is no surface.

    `depth` (H, W) is in units, 0 = no surface; `views` are the indices of the context views of this step, all by
    default. With `config.loss.target_view` the target's own view, which has no gradient, is one more of the mean.
    """
    views = range(len(contexts)) if views is None else views
    parts = [view_loss(depth, target, contexts[v], config, state, state.seen[v]) for v in views]
    if config.loss.target_view:
        parts.append(view_loss(depth, target, target, config, state))
    value, gradient = (sum(part[k] for part in parts) / len(parts) for k in (0, 1))
    return float(value), depth.size * gradient
