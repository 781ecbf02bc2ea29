"""Errors of a depth map and of its normals against the truth, near discontinuities apart from the rest."""

from dataclasses import dataclass

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.method.view.prediction import sized
from pagas_cl.scene.depthmap import central_normals

_NEAR = 3           # pixels from a discontinuity, within which errors are counted apart
_JUMP = 6.0         # pixel footprints by which depths of neighbours differ at a discontinuity


@dataclass(frozen=True)
class DepthErrors:
    """Errors over one set of pixels.

    `pixels` have a depth in both maps, `missing` a true depth alone. `mean`, `median`: absolute depth error, scene
    units, and in pixels of parallax (`..._parallax`, nan where no parallax was given). `normal_...`: angle between
    normals, degrees, over the pixels whose normal is defined in both maps.
    """

    pixels: int
    missing: int
    mean: float
    median: float
    mean_parallax: float
    median_parallax: float
    normal_mean: float
    normal_median: float


@dataclass(frozen=True)
class DepthReport:
    """`smooth`: away from discontinuities; `edges`: within 3 pixels of one; `all`: both."""

    smooth: DepthErrors
    edges: DepthErrors
    all: DepthErrors


def compare_depth(depth, truth, camera, *, parallax=None, true_normals=None, mask=None) -> DepthReport:
    """Compare a depth map (H, W), z-depth, 0 = no surface, with the truth; both are of the camera's size.

    `parallax`: depth of one pixel of parallax, scene units, one or (H, W): see `depth_per_parallax`; `true_normals`
    (H, W, 3): unit, camera frame, towards the camera, where they are not to be taken from the true depth; `mask`, bool
    (H, W): pixels that count. InputError: one of another shape.
    """
    depth, truth = _checked(depth, camera, "depth map"), _checked(truth, camera, "true depth map")
    for what, given, shapes in (("parallax", parallax, [truth.shape, ()]), ("mask", mask, [truth.shape]),
                                ("true_normals", true_normals, [(*truth.shape, 3)])):
        if given is not None and np.shape(given) not in shapes:
            raise InputError(f"{what} has shape {np.shape(given)}, expected {shapes[0]}, as the depth map has")
    near = dilate(find_discontinuities(truth, camera), _NEAR)
    inside = np.ones(truth.shape, bool) if mask is None else np.asarray(mask, bool)
    angle = _angles(central_normals(depth, camera),
                    central_normals(truth, camera) if true_normals is None else np.asarray(true_normals, np.float64))
    per_pixel = np.nan if parallax is None else np.asarray(parallax, np.float64)
    return DepthReport(*(_errors(depth, truth, per_pixel, angle, inside & part)
                         for part in (~near, near, np.ones_like(near))))


def _errors(depth, truth, per_pixel, angle, where):
    both = where & (depth > 0) & (truth > 0)
    error = np.abs(depth - truth)
    shift = np.broadcast_to(error / np.where(per_pixel > 0, per_pixel, np.nan), error.shape)
    known = [values[both & np.isfinite(values)] for values in (error, shift, angle)]
    figures = (float(of(values)) if len(values) else float("nan") for values in known for of in (np.mean, np.median))
    return DepthErrors(int(both.sum()), int((where & (depth <= 0) & (truth > 0)).sum()), *figures)


def _angles(a, b):
    with np.errstate(invalid="ignore"):
        ok = (np.abs((a**2).sum(-1) - 1) < 1e-3) & (np.abs((b**2).sum(-1) - 1) < 1e-3)
        # atan2 keeps its digits at small angles, where arccos loses them
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))
    return np.where(ok, angle, np.nan)


def find_discontinuities(depth, camera) -> np.ndarray:
    """Pixels more than 6 footprints off one of 4 neighbours, or next to one without depth: bool (H, W)."""
    depth = np.asarray(depth, np.float64)
    found = np.zeros(depth.shape, bool)
    limit = _JUMP / np.sqrt(camera.fx * camera.fy)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        broken = (np.abs(depth[a] - depth[b]) > limit * np.minimum(depth[a], depth[b])) | (
            (depth[a] > 0) != (depth[b] > 0))
        found[a] |= broken
        found[b] |= broken
    return found


def dilate(mask, radius: int) -> np.ndarray:
    """Pixels within `radius` (Euclidean) of a true one: bool (H, W)."""
    mask = np.asarray(mask, bool)
    h, w = mask.shape
    padded = np.pad(mask, radius)
    out = np.zeros_like(mask)
    for dy in range(-radius, radius + 1):
        reach = int(np.sqrt(radius**2 - dy**2))
        for dx in range(-reach, reach + 1):
            out |= padded[radius + dy:radius + dy + h, radius + dx:radius + dx + w]
    return out


def depth_per_parallax(depth, target, contexts) -> np.ndarray:
    """Depth that moves a pixel's point by one pixel in the other views, root mean square over those that see it.

    From a depth map (H, W) and Cameras: float64 (H, W), scene units; 0 where the pixel has no depth or no view sees it.
    """
    depth, rays = np.asarray(depth, np.float64), target.rays()
    speed, seen = np.zeros(depth.shape), np.zeros(depth.shape)
    for context in contexts:
        rotation, tau = context.relative_to(target)
        q = rays @ rotation.T
        point = depth[..., None] * q + tau
        with np.errstate(divide="ignore", invalid="ignore"):
            z = point[..., 2]
            u, v = context.fx * point[..., 0] / z + context.cx, context.fy * point[..., 1] / z + context.cy
            mx = context.fx * (q[..., 0] * tau[2] - q[..., 2] * tau[0]) / z**2
            my = context.fy * (q[..., 1] * tau[2] - q[..., 2] * tau[1]) / z**2
            inside = (depth > 0) & (z > 0) & (u >= 0) & (v >= 0) & (u < context.width) & (v < context.height)
        speed += np.where(inside, mx**2 + my**2, 0.0)
        seen += inside
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(speed > 0, np.sqrt(seen / speed), 0.0)


def _checked(depth, camera, what):
    depth = sized(depth, camera, what)
    if not np.isfinite(depth).all():
        raise InputError(f"{what} holds values that are not finite; mark pixels without surface by 0")
    return depth
