"""The pictures of one refined view, as arrays: the photo, depth and normals before and after, what changed by how much.

Colour maps are anchors with straight lines between; each rises evenly in lightness, "signed" from both ends to white.
"""

from dataclasses import dataclass

import numpy as np

from pagas_cl.method.view.prediction import project_depth
from pagas_cl.result import normals_of
from pagas_cl.scene.camera import Camera

_SMALLEST_CHANGE = 0.1  # pixels: where nothing moved the scale does not blow rounding up to full colour
_ROWS = 64              # of a picture worked out at a time
NOTHING = (34, 34, 34)  # colour of a pixel without a value
_CLAY, _LIGHT = (214, 208, 198), np.array([-0.62, -0.62, -0.48])  # as in viewer.js

MAPS = {
    "sequential": ((48, 18, 84), (49, 75, 140), (33, 128, 141), (62, 180, 112), (170, 216, 60), (253, 236, 80)),
    "signed": ((20, 60, 140), (90, 150, 215), (200, 222, 240), (255, 255, 255), (250, 214, 190), (225, 120, 85),
               (140, 20, 40)),
}


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture, uint8 (H, W, 3): `key` is part of the file's name, `title` the heading on the page.

    `legend`: what the colours mean, in words and numbers; `map_name`: the colour map of its strip, if there is one.
    """

    key: str
    title: str
    pixels: np.ndarray
    legend: str = ""
    map_name: str = ""


def view_pictures(photo, camera: Camera, before, after, *, change, confidence,
                  given: Camera | None = None) -> list[Picture]:
    """Every picture of one view: of its photo, uint8 (H, W, 3), and its z-depths (H, W), 0 = no surface.

    `change` (H, W) is the signed move in pixels of parallax (`change_in_units`), NaN = unknown; `confidence` (H, W) is
    from 0 to 1; `given`: the camera as it was, where `camera` is a refined one.
    """
    low, high = depth_range(before, after)
    depths = {"before": np.asarray(before), "after": np.asarray(after)}
    pictures = [Picture("photo", "photo", np.asarray(photo, np.uint8))]
    pictures += [Picture(f"depth_{when}", f"depth {when}", colored(depth, low, high, depth > 0),
                         f"z-depth from {low:.4g} to {high:.4g} scene units", "sequential")
                 for when, depth in depths.items()]
    for when, depth in depths.items():
        normals = normals_of(depth, camera)
        rgb = normal_colors(normals, (normals != 0).any(axis=-1))
        pictures.append(Picture(f"normals_{when}", f"normals {when}", rgb,
                                "red: to the right, green: up, blue: towards the camera"))
    known = np.isfinite(change)
    most = max(float(np.percentile(np.abs(change[known]), 99)) if known.any() else 0.0, _SMALLEST_CHANGE)
    pictures.append(Picture("change", "change", colored(change, -most, most, known, "signed"),
                            f"pixels of parallax, from {-most:.2g} (nearer) to {most:.2g} (farther)", "signed"))
    pictures.append(Picture("confidence", "confidence", colored(confidence, 0, 1, after > 0),
                            "from 0 (the photos say nothing) to 1 (they fix the depth)", "sequential"))
    if given is not None:
        (uv, z), (own, _) = (project_depth(camera, other, np.asarray(after)) for other in (given, camera))
        moved, known = np.linalg.norm(uv - own, axis=-1), (np.asarray(after) > 0) & (z > 0)
        most = max(depth_range(np.where(known, moved, 0))[1], _SMALLEST_CHANGE)
        pictures.append(Picture("camera", "camera", colored(moved, 0, most, known),
                                f"pixels that the photo was off by, as its refined camera has it: from 0 to {most:.2g}",
                                "sequential"))
    return pictures


def shaded_pictures(view, before, after) -> list[Picture]:
    """Two surfaces lit alike in a View, by their z-depths (H, W), 0 = no surface, and the view's photo."""
    legend = f"lit from the upper left, seen from view {view.name}"
    return [*(Picture(f"shaded_{when}", f"shaded {when}", shaded(depth, view.camera), legend)
              for when, depth in (("before", before), ("after", after))),
            Picture("photo", "photo", np.asarray(view.load_image(), np.uint8), view.name)]


def shaded(depth, camera: Camera) -> np.ndarray:
    """A depth map (H, W) as a lit surface of one colour, uint8 (H, W, 3); NOTHING where it has no normal."""
    normals = normals_of(np.asarray(depth), camera)
    facing = np.where((normals * camera.rays()).sum(axis=-1, keepdims=True) > 0, -normals, normals)
    light = 0.1 + 0.84 * np.maximum(facing @ _LIGHT, 0) + 0.08 * np.maximum(-facing[..., 2], 0)
    rgb = (np.array(_CLAY) / 255) * light[..., None] ** (1 / 2.2) * 255
    return np.where((normals != 0).any(axis=-1, keepdims=True), np.rint(np.minimum(rgb, 255)), NOTHING).astype(np.uint8)


def depth_range(*depths) -> tuple[float, float]:
    """First and last percentile of all valid depths, (0, 1) where there is none."""
    values = np.concatenate([depth[depth > 0].ravel()[::7] if depth.size > 10_000 else depth[depth > 0].ravel()
                             for depth in map(np.asarray, depths)])
    if not values.size:
        return 0.0, 1.0
    low, high = np.percentile(values, (1, 99))
    return float(low), float(max(high, low * (1 + 1e-9)))


def change_in_units(before, after, parallax) -> np.ndarray:
    """(after - before) / parallax where all three are above 0, NaN at other pixels."""
    known = (np.asarray(before) > 0) & (np.asarray(after) > 0) & (np.asarray(parallax) > 0)
    return np.where(known, (np.asarray(after, np.float64) - before) / np.where(known, parallax, 1), np.nan)


def colored(values, low: float, high: float, valid, map_name: str = "sequential") -> np.ndarray:
    """Colours, uint8 (H, W, 3), of `values` (H, W) clipped to `low` .. `high`; NOTHING where not `valid`, (H, W)."""
    anchors = np.array(MAPS[map_name], np.float64)
    places = np.linspace(0, 1, len(anchors))

    def rows(values, valid) -> np.ndarray:
        share = np.clip((np.where(valid, values, low) - low) / max(high - low, 1e-30), 0, 1)
        rgb = np.stack([np.interp(share, places, anchors[:, channel]) for channel in range(3)], axis=-1)
        return np.where(valid[..., None], np.rint(rgb), NOTHING)

    return _in_colour(rows, np.asarray(values), valid)


def normal_colors(normals, valid) -> np.ndarray:
    """Colours, uint8 (H, W, 3), of unit normals (H, W, 3) in camera axes, turned to the camera."""
    def rows(normals, valid) -> np.ndarray:
        facing = np.where(normals[..., 2:] > 0, -normals, normals) * (1, -1, -1)
        return np.where(valid[..., None], np.rint((facing + 1) * 127.5), NOTHING)

    return _in_colour(rows, normals, valid)


def _in_colour(rows, *maps) -> np.ndarray:
    """uint8 (H, W, 3) of `rows(...)`, which works out a strip from those of all `maps`: in little memory."""
    pixels = np.empty((*maps[0].shape[:2], 3), np.uint8)
    for start in range(0, len(pixels), _ROWS):
        pixels[start:start + _ROWS] = rows(*(part[start:start + _ROWS] for part in maps))
    return pixels


def css_gradient(map_name: str) -> str:
    """The colour map as a CSS background, for the legend of the page."""
    return f"linear-gradient(90deg, {', '.join(f'rgb({r},{g},{b})' for r, g, b in MAPS[map_name])})"
