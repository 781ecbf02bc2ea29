"""Depth maps on disk and at other sizes: (H, W) float32, z-depth in scene units, 0 = no surface.

Convention: an image is resampled such that its corners stay in place (`Camera.resized`), so that output pixel j covers
input from j n_in / n_out to (j + 1) n_in / n_out. Any ratio is allowed, not only 2.
"""

from collections.abc import Iterable, Sequence
from numbers import Real
from os.path import isfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, as_path, log, short
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.formats import SUFFIXES, check_aspect, check_pixels, plane_of, read_values, stored_shape
from pagas_cl.scene.images import as_array
from pagas_cl.scene.names import file_stems
from pagas_cl.system.files import replaced, write_arrays

# What became of each pixel's depth; DepthResult.status says what each means.
NO_SURFACE, REFINED, KEPT, REJECTED = range(4)
_HALF = 0.5 - 1e-7      # of the covered area, but for rounding


def find_depth(folder: str | Path, image_name: str) -> Path | None:
    """The depth map of a photo in `folder`: `<stem>` or the whole `<image name>` (as COLMAP does) plus a suffix."""
    whole = as_path("image_name", image_name)
    return _first(as_path("folder", folder), (str(image_name), str(whole.with_suffix("")), whole.name, whole.stem))


def find_depths(folder: str | Path, names: Sequence[str], others: Sequence[str] = ()) -> list[Path | None]:
    """`find_depth` of every view of a scene; first of all the files that a run of pagas_cl has written. `others`: names
    of the scene's other views, by which files are called too.

    InputError where a file could be of several views: `0001.npz` of left/0001.png and right/0001.png.
    """
    folder = Path(folder)
    stems = file_stems([*names, *others])[:len(names)]
    own = [_first(folder, (stem,)) for stem in stems]
    files = [file or find_depth(folder, name) for file, name in zip(own, names)]
    claimed: dict[Path, int] = {file: place for place, file in enumerate(own) if file is not None}
    for place, file in enumerate(files):
        first = place if file is None else claimed.setdefault(file, place)
        if file is not None and first != place:
            raise InputError(f"depth map {str(file)!r} could be of view {names[first]!r} and of {names[place]!r}: name "
                             f"one for each, {stems[first]}{file.suffix} and {stems[place]}{file.suffix}")
    return files


def _first(folder: Path, stems: Iterable[str]) -> Path | None:
    return next((folder / (stem + suffix) for suffix in SUFFIXES for stem in stems
                 if isfile(folder / (stem + suffix))), None)


def load_depth(path: str | Path, size: tuple[int, int] | None = None, *,
               scale: float | None = None) -> npt.NDArray[np.float32]:
    """Read a depth map: (H, W) float32, 0 where it is not finite or below 0.

    Parameters
    ----------
    path : path
        .npz (its array "depth", else the first), .npy, .pfm, 16-bit .png, COLMAP's .geometric.bin / .photometric.bin,
        or .exr.
    size : (width, height), optional
        The photo's size, to which the map is resampled by `resize_depth`. A map of far more pixels, or of another shape
        than the photo, is refused by its header.
    scale : float, optional
        The file's number for one scene unit (1000 for millimetres in a scene of metres); a PNG needs it, else 1.
    """
    path = as_path("path", path)
    check_unit(path, scale)
    if scale is not None and not (isinstance(scale, Real) and 0 < scale < np.inf):
        raise InputError(f"depth scale is {short(scale)}, expected a number above 0")
    who = f"depth map {str(path)!r}"
    if size is not None:
        if np.shape(size) != (2,) or not all(isinstance(side, Real) and side >= 1 for side in size):
            raise InputError(f"size is {short(size)}, expected (width, height) of the photo in pixels")
        check_pixels(shape := stored_shape(path), size, who)
        check_aspect(*plane_of(shape, who), size, who)
    values = read_values(path)
    depth = clean_depth(values if scale is None else values / scale, str(path))
    return depth if size is None else stretched_depth(depth, *size)


def check_unit(path: Path, scale: float | None) -> None:
    """InputError where the file does not say its unit, and no `scale` does."""
    if scale is None and path.suffix.lower() == ".png" and path.is_file():
        raise InputError(f"depth map {str(path)!r}: a PNG does not say its unit; give the depth scale (1000 for "
                         "millimetres in a scene of metres)")


def surface_depth(depth: np.ndarray) -> npt.NDArray[np.float32]:
    """A copy as float32, 0 where there is no surface: 0, negative, not finite, or too large for float32."""
    with np.errstate(over="ignore"):
        depth = depth.astype(np.float32)
    bits = depth.view(np.uint32)
    bits *= (depth > 0) & (depth < np.inf)      # times 0 or 1, on the bits: NaN and infinity end too
    return depth


def clean_depth(values: npt.ArrayLike, who: str = "depth map") -> npt.NDArray[np.float32]:
    """Depth as (H, W) float32 with what is not finite, or below 0, set to 0 (and counted in the log)."""
    values = np.asarray(values)
    values = values.reshape(plane_of(values.shape, who))
    if values.dtype.kind not in "fiu":
        raise InputError(f"{who} has dtype {values.dtype}, expected numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        depth = values.astype(np.float32)
        bad = ~np.isfinite(depth) | (depth < 0)
    count = int(np.count_nonzero(bad))
    if count:
        log.info("%s: %d of %d depths are not finite or below 0: no surface is assumed there", who, count, depth.size)
        depth[bad] = 0
    return depth


def save_depth(path: str | Path, depth: npt.ArrayLike) -> None:
    """Write a depth map (H, W) as an .npz with one array, "depth", float32; under another name first, then renamed.

    InputError: the name does not end in .npz, or `depth` is none.
    """
    who = f"depth map {str(path)!r}"
    if as_path("path", path).suffix.lower() != ".npz":
        raise InputError(f"{who}: expected a name that ends in .npz, the one kind that save_depth writes")
    values = as_array(depth, who, "(height, width)")
    values = np.ascontiguousarray(values.reshape(plane_of(values.shape, who)), np.float32)
    with replaced(path) as temporary, open(temporary, "wb") as file:
        write_arrays(file, {"depth": values})


def resize_depth(depth: npt.ArrayLike, width: int, height: int) -> npt.NDArray[np.float32]:
    """The depth map (H, W) of a photo of another size: linear where it grows, else the mean, over valid depths.

    A pixel is valid iff the input pixel that its centre lies in is (where it shrinks: iff half of the covered area is).
    InputError where the map has another shape than the photo (by more than 3 %): it is transposed, or was cropped.
    """
    depth = surface_depth(np.asarray(depth))
    check_aspect(*plane_of(depth.shape, "depth map"), (width, height), "depth map")
    return stretched_depth(depth, width, height)


def stretched_depth(depth: np.ndarray, width: int, height: int) -> npt.NDArray[np.float32]:
    """The same of float32 (H, W) that may have another shape than the photo, as networks that see squares have it."""
    if depth.shape == (height, width):
        return depth
    if width <= depth.shape[1] and height <= depth.shape[0]:
        total, share = _valid_sums(depth, width, height)
        return np.ascontiguousarray(np.where(share > _HALF, _mean(total, share), np.float32(0)))
    valid = nearest(depth > 0, width, height)
    return np.ascontiguousarray(np.where(valid, depth_up(depth, width, height), np.float32(0)))


def nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Values (H, W) at another size: that of the pixel in which a pixel's centre lies."""
    rows = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(np.intp)
    return np.asarray(values[rows[:, None], columns[None, :]])


def depth_down(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth (H, W) at a coarser size: mean of the valid (> 0) among the covered pixels, 0 where there is none."""
    if depth.shape == (height, width):
        return depth
    return _mean(*_valid_sums(depth, width, height))


def _valid_sums(depth: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the valid (> 0) depths among the covered pixels, the others as 0, and the share that is valid."""
    valid = depth > 0
    if valid.all():
        return _shrunk(depth, width, height), np.ones((height, width))
    return _shrunk(np.where(valid, depth, 0), width, height), _shrunk(valid, width, height)


def depth_up(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth (H, W) at a finer size: bilinear at pixel centres over the valid (> 0) neighbours, 0 where there is none.

    Validity grows by up to a pixel of the coarse level: one valid neighbour is enough.
    """
    x, y = (np.arange(width) + 0.5) * depth.shape[1] / width, (np.arange(height) + 0.5) * depth.shape[0] / height
    return valid_mean(depth, x, y)


def confidence_of(depth: np.ndarray, deviation: np.ndarray, parallax: np.ndarray) -> npt.NDArray[np.float32]:
    """Confidence of depths; see DepthResult.confidence."""
    with np.errstate(divide="ignore", invalid="ignore"):
        trust = 1 / (1 + np.square(deviation.astype(np.float64) / parallax))
    return np.where((depth > 0) & (parallax > 0) & np.isfinite(trust), trust, 0).astype(np.float32)


def central_normals(depth: npt.ArrayLike, camera: Camera, first: int = 0) -> npt.NDArray[np.float64]:
    """Unit normals (H, W, 3) by central differences of the depth map's points, in camera coordinates, towards the
    camera; NaN where a pixel or one of its four neighbours has no depth, or the points are on a line. `depth` may be
    some rows of the map, from the one number `first` on."""
    depth = np.asarray(depth, np.float64)
    points = np.where(depth > 0, depth, np.nan)[..., None] * camera.rays(first, len(depth))
    normals = np.full(points.shape, np.nan)
    normals[1:-1, 1:-1] = _normals_across(points[1:-1, 1:-1], points[2:, 1:-1] - points[:-2, 1:-1],
                                          points[1:-1, 2:] - points[1:-1, :-2])
    return normals


def central_normals_at(depth: np.ndarray, camera: Camera, rows: np.ndarray,
                       columns: np.ndarray) -> npt.NDArray[np.float64]:
    """central_normals of some pixels (n,) of a depth map (H, W): (n, 3)."""
    height, width = depth.shape

    def point(down: int, right: int) -> npt.NDArray[np.float64]:
        v, u = rows + down, columns + right
        inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
        z = np.where(inside, depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0).astype(np.float64)
        return np.where(z > 0, z, np.nan)[:, None] * camera.rays_at(v, u)

    return _normals_across(point(0, 0), point(1, 0) - point(-1, 0), point(0, 1) - point(0, -1))


def _normals_across(points: np.ndarray, down: np.ndarray, right: np.ndarray) -> npt.NDArray[np.float64]:
    """Unit normals (..., 3) across two directions at points, towards the camera in this order of image axes."""
    cross = np.cross(down, right)
    cross[np.isnan(points[..., 0])] = np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(cross / np.linalg.norm(cross, axis=-1, keepdims=True))


def valid_mean(depth: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Mean of the valid (> 0) of the four neighbours of each position of a grid `x` (w,), `y` (h,), pixels, by their
    bilinear shares: float32 (h, w), 0 where there is none."""
    total, weight = np.zeros((len(y), len(x))), np.zeros((len(y), len(x)))
    for rows, wy in taps(y, depth.shape[0]):
        for columns, wx in taps(x, depth.shape[1]):
            corner = depth[rows[:, None], columns[None, :]]
            share = np.where(corner > 0, wy[:, None] * wx[None, :], 0)
            total += share * np.where(corner > 0, corner, 0)
            weight += share
    return _mean(total, weight)


def _mean(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    some = weight > 1e-9
    return np.where(some, total / np.where(some, weight, 1), 0).astype(np.float32)


def taps(at: np.ndarray, side: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Lower and upper neighbour of every position, each with its share."""
    at = np.clip(at - 0.5, 0, side - 1)
    low = np.minimum(at.astype(np.intp), max(side - 2, 0))
    return (low, 1 - (at - low)), (np.minimum(low + 1, side - 1), at - low)


def _shrunk(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average over both axes, float64."""
    return _along(_along(values, height, 0), width, 1)


def _along(values: np.ndarray, n_out: int, axis: int) -> np.ndarray:
    n_in = values.shape[axis]
    if n_out == n_in:
        return values.astype(np.float64)
    values = np.moveaxis(values, axis, 0)
    if n_in % n_out == 0:
        step = n_in // n_out
        result = values[::step].astype(np.float64)
        for k in range(1, step):        # in place: new memory takes longer than what is added
            result += values[k::step]
        result /= step
    else:
        # the integral of the piecewise constant signal at the cells' borders; its differences are the cells' sums
        integral = np.zeros((n_in + 1, *values.shape[1:]))
        np.cumsum(values, axis=0, dtype=np.float64, out=integral[1:])
        border = np.arange(n_out + 1) * (n_in / n_out)
        low = np.minimum(border.astype(np.intp), n_in - 1)
        share = (border - low).reshape(-1, *[1] * (values.ndim - 1))
        at = integral[low] * (1 - share) + integral[low + 1] * share
        result = np.diff(at, axis=0) * (n_out / n_in)
    return np.moveaxis(result, 0, axis)
