"""Why was nothing refined? The mistakes that people make with photos, masks, units and poses, each tried.

What makes photos agree over depth maps where they do not as given is the likeliest reason. A few views and patches.
"""

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, NothingRefinedWarning
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check import patches
from pagas_cl.scene.check.cameras import UNITS
from pagas_cl.scene.check.conventions import POSES, ROTATED
from pagas_cl.scene.depthmap import depth_down, surface_depth
from pagas_cl.scene.inputs import Depth, depth_array, with_depth
from pagas_cl.scene.mesh import Surface, grid_faces
from pagas_cl.scene.sampling import NEAR, evenly
from pagas_cl.scene.view import View

_VIEWS = 6           # that are looked at
_SIDE = 96           # pixels of the longer side of the depth maps that a mesh is made of
_EDGE = 0.05         # triangles whose depths differ by more than this share span a depth edge
_SAMPLES = 12_000
_FLAT = 1.5          # grey levels of 255; a photo of less standard deviation shows nothing
_LITTLE = 0.02       # share of the depths; masks that leave less are suspicious
_HARDLY = 0.1        # share of the depths that is hardly any
_CLEAR = 0.6         # of 1 - correlation as given: photos that leave more than this do not agree clearly better
_AGREE = 0.5         # correlation of photos that agree
_FIGURES = re.compile(r"\([^)]*\)|[\d.]+")


def likely_reasons(views: Sequence[View], depths: Sequence[Depth | None]) -> list[str]:
    """Sentences, the likeliest first; empty where none of the usual mistakes explains it.

    `depths` as in refine_views: z-depth in scene units, one a view or None.
    """
    have = with_depth(depths)
    if not have:
        return []
    near = [have[n] for n in patches.from_middle([views[k].camera for k in have])[:_VIEWS]]
    some = [views[k] for k in near]
    maps = [surface_depth(depth_array(depth)) for k in near if (depth := depths[k]) is not None]
    greys = [patches.grey_of(view.load_image()) for view in some]
    flat = sum(float(grey.std()) < _FLAT for grey in greys)
    if 2 * flat > len(greys):
        return [f"{flat} of {len(greys)} photos that were looked at are of one colour (black?)"]
    return _of_masks(some, maps) or _of_background(maps) or _of_readings(views, near, maps, greys)


def _of_masks(views: list[View], maps: list[np.ndarray]) -> list[str]:
    masks = [view.load_mask() for view in views]
    valid = sum(np.count_nonzero(depth > 0) for depth in maps)
    left = sum(np.count_nonzero(depth if mask is None else depth * mask) for depth, mask in zip(maps, masks))
    share = left / max(1, valid)
    if left == valid or share > _LITTLE:
        return []
    return [f"the masks leave {share:.1%} of the depths, the other way round they would leave {1 - share:.0%}: are "
            "they inverted (true or white is what is used), or empty?"]


def _of_background(maps: list[np.ndarray]) -> list[str]:
    """A view's unit is its median depth: where that is the background's, the surface is too near for a Gaussian."""
    valid = np.concatenate([depth[depth > 0] for depth in maps])
    far = valid.max(initial=0)
    surface = valid[valid < NEAR * far]
    if not 0 < len(surface) < np.count_nonzero(valid == far):
        return []
    return [f"{np.mean(valid == far):.0%} of the depths are {far:g}, the others' median is {np.median(surface):.4g}: "
            "is that what a renderer writes where there is no surface (expected 0)?"]


def _of_readings(views: Sequence[View], near: list[int], maps: list[np.ndarray], greys: list[np.ndarray]) -> list[str]:
    cameras = [views[k].camera for k in near]
    surface = _surface(cameras, maps)
    given = _agreement(cameras, surface, greys)
    tried = [(_agreement(cameras, _surface(cameras, [depth * np.float32(unit) for depth in maps]), greys),
              f"with depths times {unit:.4g}", f"is their unit not the cameras' (a depth scale of {1 / unit:.4g})?")
             for unit in UNITS]
    if surface is not None and given < _AGREE:       # a flat one with the origin on it is the same, smaller
        tried += [(_agreement(cameras, replace(surface, vertices=unit * surface.vertices), greys),
                   f"with the surface scaled by {unit:.4g} about the origin",
                   "is the surface in another unit than the cameras?") for unit in UNITS]
    for way in POSES[1:]:
        others = [way.of(camera) for camera in cameras]
        tried += [(_agreement(others, seen, greys), f"with {way.matrices} of the cameras",
                   "are the poses read the wrong way round?")
                  for seen in (_surface(others, maps), surface)]     # of depth maps; of a mesh, which stays
    tried += [(_agreement([way.of(camera) for camera in cameras], surface, greys), f"with the cameras {way.name}",
               "has another program taken y for up, or z?") for way in ROTATED]
    for step in (-1, 1):
        places = [(k + step) % len(views) for k in near]
        same = [views[place].camera.width == camera.width and views[place].camera.height == camera.height
                for place, camera in zip(places, cameras)]
        if len(views) > 2 and all(same):
            photos = [patches.grey_of(views[place].load_image()) for place in places]
            tried.append((_agreement(cameras, surface, photos), f"with the {'next' if step > 0 else 'last'} camera's "
                          "photo for each", "are photos and cameras paired rightly?"))
    better = sorted((found for found in tried if found[0] > max(_AGREE, 1 - _CLEAR * (1 - given))), reverse=True)
    return [f"{how} the photos agree ({agreement:.2f}, as given "
            f"{f'{given:.2f}' if given > -1 else 'none shows what another one does'}): {question}"
            for agreement, how, question in better[:1]]


def _surface(cameras: list[Camera], maps: list[np.ndarray]) -> Surface | None:
    """What the depth maps show; None where that is nothing."""
    try:
        return mesh_of_depths(cameras, maps)
    except InputError:
        return None


def _agreement(cameras: list[Camera], surface: Surface | None, greys: list[np.ndarray]) -> float:
    """Median correlation of patches between pairs of photos, looked up on the surface; -1 where too few are seen."""
    if surface is None:
        return -1.0
    samples = patches.sample_surface(surface, _SAMPLES)
    seen, pairs = patches.overlaps(cameras, samples)
    scores = patches.patch_correlation(cameras, greys, pairs, seen, samples)
    known = scores[np.isfinite(scores)]
    return float(np.median(known)) if len(known) >= patches.LEAST else -1.0


def commonest(reasons: Sequence[str]) -> tuple[str, int]:
    """The reason that most of the views have, and how many do; figures and names in brackets do not count: where they
    differ from view to view, it is that of the first one, "for instance"."""
    kinds = [_FIGURES.sub("", reason) for reason in reasons]
    kind, times = Counter(kinds).most_common(1)[0]
    first = reasons[kinds.index(kind)]
    return first if reasons.count(first) == times else f"for instance, {first}", times


def warn_of_nothing(views: Sequence[View], depths: Sequence[Depth | None], results: Sequence[Any]) -> None:
    """Warn (NothingRefinedWarning) where of all results hardly a depth was refined, with the likeliest reason."""
    counts = Counter[str]()
    for result in results:
        counts.update(result.counts)
    total, refined = sum(counts.values()) - counts["no surface"], counts["refined"]
    if total and refined < _HARDLY * total:
        returned = [result.reason for result in results if result.reason]
        head = "nothing was refined" if not refined else "hardly anything was refined"
        reasons = likely_reasons(views, depths)
        if returned and not reasons:
            reason, times = commonest(returned)
            reasons = [f"{times} of {len(results)} views: {reason}"]
        warnings.warn(f"{head}: {refined:,} of {total:,} depths, {len(returned)} of {len(results)} views were not "
                      f"refined; {'likeliest: ' + reasons[0] if reasons else 'no usual mistake explains it'}",
                      NothingRefinedWarning, stacklevel=3)


def mesh_of_depths(cameras: Sequence[Camera], depths: Sequence[Depth | None]) -> Surface:
    """Triangles between neighbouring pixels of a few of the depth maps (None where a view has none), made small."""
    have = [k for k, depth in enumerate(depths) if depth is not None]
    chosen = [have[n] for n in evenly(len(have), _VIEWS)]
    vertices, faces = list[np.ndarray](), list[np.ndarray]()
    for k in chosen:
        full = depth_array(depths[k])
        scale = min(1.0, _SIDE / max(full.shape))
        camera = cameras[k].resized(max(2, round(full.shape[1] * scale)), max(2, round(full.shape[0] * scale)))
        depth = depth_down(full, camera.width, camera.height).astype(np.float64)
        points = (camera.rays() * depth[..., None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        found = grid_faces(camera.width, camera.height)
        at = depth.ravel()[found]
        kept = found[(at > 0).all(axis=1) & (at.max(axis=1) < (1 + _EDGE) * at.min(axis=1))]
        used, renumbered = np.unique(kept, return_inverse=True)
        faces.append(renumbered.reshape(-1, 3) + sum(map(len, vertices)))
        vertices.append(points.reshape(-1, 3)[used])
    if not any(map(len, vertices)):
        raise InputError("no depth map has a surface: nothing can be compared with the photos")
    return Surface(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
