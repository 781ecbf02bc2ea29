"""Where a photo lies in the smaller image that a network (or a depth sensor) saw: stretched to it, padded, or cropped.

    x in the small image = scale_x * x in the photo + offset_x,  likewise y;  pixels, origin at the corner
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check.patches import grey_of
from pagas_cl.scene.depth.formats import PATCH, most_bent
from pagas_cl.scene.depthmap import stretched_depth, valid_mean
from pagas_cl.scene.images import bilinear, image_size, photo_to, read_photo

_SAME = 0.8           # least correlation of the photo and the small image
_NEAR = 1.0           # pixels of the small image: placements that differ by less are one
_COMPARED = 96        # samples along a side


@dataclass(frozen=True)
class Placement:
    """See above; `kind` is the word for it."""

    scale: tuple[float, float]
    offset: tuple[float, float]
    kind: str = "stretched"

    def photo_camera(self, small: Camera, width: int, height: int) -> Camera:
        """The camera of the photo, `width` x `height` pixels, from that of the small image."""
        (sx, sy), (ox, oy) = self.scale, self.offset
        return Camera(width, height, small.fx / sx, small.fy / sy, (small.cx - ox) / sx, (small.cy - oy) / sy,
                      small.world_to_camera, small.name)

    def photo_depth(self, depth: np.ndarray, width: int, height: int) -> npt.NDArray[np.float32]:
        """The depth map at the photo's size: float32, 0 where the small image did not reach."""
        x = (np.arange(width) + 0.5) * self.scale[0] + self.offset[0]
        y = (np.arange(height) + 0.5) * self.scale[1] + self.offset[1]
        if self.offset == (0, 0) and np.allclose(self.scale, (depth.shape[1] / width, depth.shape[0] / height)):
            return stretched_depth(depth, width, height)
        inside_x, inside_y = (x >= 0) & (x < depth.shape[1]), (y >= 0) & (y < depth.shape[0])
        out = np.zeros((height, width), np.float32)
        x, y, depth = x[inside_x], y[inside_y], np.asarray(depth, np.float32)
        valid = depth[np.ix_(y.astype(np.intp), x.astype(np.intp))] > 0       # the pixel that a position lies in
        out[np.ix_(inside_y, inside_x)] = np.where(valid, valid_mean(depth, x, y), np.float32(0))
        return out


def stretched(photo: tuple[int, int], small: tuple[int, int]) -> Placement:
    """The whole photo fills the small image; sizes are (width, height)."""
    return Placement((small[0] / photo[0], small[1] / photo[1]), (0, 0))


def placements(photo: tuple[int, int], small: tuple[int, int]) -> list[Placement]:
    """Every placement by which a network may have made its image of the photo, the simplest first."""
    w, h = photo
    W, H = small
    found = [stretched(photo, small)]
    for s, kind in ((min(W / w, H / h), "padded"), (max(W / w, H / h), "cropped")):
        found.append(Placement((s, s), ((W - s * w) / 2, (H - s * h) / 2), kind))
    sy = PATCH * round(h * W / w / PATCH) / h       # widths are exact there, heights rounded, then cut
    if sy > 0:
        found.append(Placement((W / w, sy), (0, (H - sy * h) / 2), "cropped" if sy * h > H else "padded"))
    return [way for k, way in enumerate(found) if not any(_close(way, other, photo) for other in found[:k])]


def _close(a: Placement, b: Placement, photo: tuple[int, int]) -> bool:
    """Whether no pixel of the photo moves by more than _NEAR pixels of the small image."""
    at_origin = np.subtract(a.offset, b.offset)
    at_far_corner = at_origin + np.subtract(a.scale, b.scale) * photo
    return bool(max(np.abs(at_origin).max(), np.abs(at_far_corner).max()) < _NEAR)


def find_placement(photo: Path, small: tuple[int, int], pixels: np.ndarray | None, where: str,
                   usual: str = "stretched") -> Placement:
    """How `photo` became the small image of size (width, height).

    It is found by comparing it with the small image's own `pixels` (H, W, 3); where those are not known, by the `usual`
    way of the program that made it, if the sizes allow it. InputError where neither is clear.
    """
    size = image_size(photo)
    known = placements(size, small)
    if pixels is None:
        chosen = next((way for way in known if way.kind == usual), known[0])
        bent = abs(chosen.scale[0] / chosen.scale[1] - 1)
        if bent > most_bent(*small):
            raise InputError(f"{where}: the network's image is {small[0]} x {small[1]} and {photo.name} is {size[0]} x "
                             f"{size[1]}, so that it was cropped or padded, and nothing says how; export with the "
                             "network's own images, or give it photos of one shape")
        return chosen
    image = read_photo(photo)
    scores = [_correlation(image, pixels, way) for way in known]
    if max(scores) < _SAME:
        raise InputError(f"{where}: the network's image does not show {photo.name} (correlation {max(scores):.2f}): "
                         "the photos are in another order, or turned; give them under the names, in the order and as "
                         "upright as the network had them")
    return known[int(np.argmax(scores))]      # the first of equals, the simplest


def _correlation(image: np.ndarray, pixels: np.ndarray, way: Placement) -> float:
    """Of the photo, placed in this way, with the small image."""
    height, width = image.shape[:2]
    small = grey_of(photo_to(image, max(1, round(width * way.scale[0])), max(1, round(height * way.scale[1]))))
    H, W = pixels.shape[:2]
    x, y = np.meshgrid((np.arange(_COMPARED) + 0.5) * W / _COMPARED, (np.arange(_COMPARED) + 0.5) * H / _COMPARED)
    px = (x - way.offset[0]) * small.shape[1] / (width * way.scale[0])
    py = (y - way.offset[1]) * small.shape[0] / (height * way.scale[1])
    inside = (px > 0) & (py > 0) & (px < small.shape[1]) & (py < small.shape[0])
    a = bilinear(grey_of(pixels), x[inside], y[inside])
    b = bilinear(small, px[inside], py[inside])
    a -= a.mean()
    b -= b.mean()
    return float((a * b).mean() / max(np.sqrt((a * a).mean() * (b * b).mean()), 1e-6))
