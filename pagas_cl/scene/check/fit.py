"""Where a mesh would have to be for the photos to agree over it, and what the camera check says of that. NumPy alone.

Patches of the mesh are moved along their rays to where two photos match best; the offset and scale that do this for
most of them are fitted. A depth that moves a patch along its ray moves the surface along its normal: sliding along
itself shows nowhere, and is left out of the fit where that is all that an offset does (a plane).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check import patches
from pagas_cl.scene.images import photo_to
from pagas_cl.scene.sampling import evenly

_LEVELS = ((0.25, 8, 1), (0.25, 6, 1), (0.5, 4, 1), (1.0, 2, 2))    # size of the photos, pixels to search, steps each
_LEAST_SIDE = 48     # pixels of a photo made smaller
_MOST = 100          # patches of a pair of photos
_VIEWS = 6           # that are compared with two others each
_MATCHED = 0.7       # correlation of a patch that is believed to be found
_LEAST_SHOWN = 0.1   # how much an offset must show, of the one that shows most, to be fitted
_EXPLAINED = 0.8     # of what an offset alone leaves: a scale that leaves more is none
GOOD = 0.5           # correlation of photos that agree
WELL = 0.8           # the same where mesh and cameras fit to a fraction of a pixel
_CLEARLY = 0.8       # of 1 - correlation as given: a fit that leaves more is none
_APART = 1.0         # pixels of parallax; a mesh that is off by less is for the refinement to mend
_SURE, _LIKELY = 0.9, 2 / 3     # shares of the pairs of photos that say the same
_FEW_PAIRS, _FEW_PATCHES = 3, 200


@dataclass(frozen=True)
class Alignment:
    """x -> scale x + offset, of a mesh in scene units; `pixels`: median way of its patches as other photos see it."""

    scale: float = 1.0
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pixels: float = 0.0

    def __call__(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(self.scale * points + self.offset)

    def of(self, samples: patches.Samples) -> patches.Samples:
        """The samples of the mesh as it lies then."""
        return replace(samples, points=self(samples.points))


def align(cameras: list[Camera], greys: list[np.ndarray], samples: patches.Samples,
          start: Alignment | None = None) -> Alignment | None:
    """The Alignment that the photos show, found from `start` on; None where too little of the mesh is matched."""
    found = start = start or Alignment()
    for scale, reach, fine in _LEVELS:
        scale = max(scale, min(1.0, _LEAST_SIDE / min(min(grey.shape) for grey in greys)))
        small = [camera.scaled(scale) for camera in cameras]
        photos = [photo_to(grey, *camera.size) for grey, camera in zip(greys, small)]
        rows = _matches(small, photos, found.of(samples), reach, fine)
        if rows is None:
            return None
        factors, away, which = rows
        *offset, growth = _fitted(factors, away)
        found = Alignment((1 + growth) * found.scale, (1 + growth) * found.offset + offset)
    moved = found(samples.points[which]) - start(samples.points[which])
    return replace(found, pixels=float(np.median(np.abs((factors[:, :3] * moved).sum(axis=1)))))


def _matches(cameras: list[Camera], greys: list[np.ndarray], samples: patches.Samples, reach: int,
             fine: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Rows of the fit: pixels a unit of offset (x, y, z), of scale (n, 4); pixels found away (n,); patches (n,)."""
    seen, pairs = patches.overlaps(cameras, samples, _VIEWS)
    factors, away, which = [], [], []
    for a, b in pairs:
        index = np.flatnonzero(seen[a] & seen[b])
        index = index[evenly(len(index), _MOST)]
        points = samples.points[index]
        normals = samples.normals[index]
        center = cameras[a].center
        ray = points - center
        near, _ = cameras[b].project(center + ray * (1 - 1e-4))
        far, _ = cameras[b].project(center + ray * (1 + 1e-4))
        speed = np.linalg.norm(far - near, axis=1) / 2e-4          # pixels of b a share of the depth
        steps = np.arange(-reach * fine, reach * fine + 1) / fine
        grid = patches.patch_grids(points, normals, cameras[a])
        own = patches.look_up(greys[a], cameras[a], grid)
        scores = np.empty((len(index), len(steps)))
        for column, step in enumerate(steps):
            stretch = (1 + step / np.maximum(speed, 1e-9))[:, None, None]
            other = patches.look_up(greys[b], cameras[b], center + (grid - center) * stretch)
            scores[:, column] = patches.correlation(own, other)
        best = np.argmax(np.nan_to_num(scores, nan=-2), axis=1)
        top = scores[np.arange(len(best)), best]
        good = (top > _MATCHED) & (best > 0) & (best < len(steps) - 1)
        toward = (normals * ray).sum(axis=1)
        good &= np.abs(toward) > 1e-9 * np.linalg.norm(ray, axis=1)
        unit = normals[good] * (speed[good] / toward[good])[:, None]
        factors.append(np.column_stack([unit, (unit * points[good]).sum(axis=1)]))
        away.append(steps[best[good]])
        which.append(index[good])
    if sum(map(len, away)) < patches.LEAST:
        return None
    return np.concatenate(factors), np.concatenate(away), np.concatenate(which)


def _fitted(factors: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Offset (3) and change of scale about the origin (1), scene units, by robust least squares in what shows."""
    # about the middle, in units of what each does on the average, so that one threshold does for all
    solved = np.linalg.lstsq(factors[:, :3], factors[:, 3], rcond=None)[0]
    about = factors.copy()
    about[:, 3] -= factors[:, :3] @ solved
    norm = np.maximum(np.sqrt((about**2).mean(axis=0)), 1e-300)
    norm[:3] = norm[:3].max()
    alone, left_alone = _robust(about[:, :3] / norm[:3], away)
    both, left = _robust(about / norm, away)
    x = (both if left < _EXPLAINED * left_alone else np.append(alone, 0.0)) / norm
    return np.append(x[:3] - x[3] * solved, x[3])


def _robust(factors: np.ndarray, away: np.ndarray) -> tuple[np.ndarray, float]:
    """The solution, without what hardly shows, and the median of what it leaves, pixels."""
    weight, x, left = np.ones(len(away)), np.zeros(factors.shape[1]), np.abs(away)
    for _round in range(15):
        root = np.sqrt(weight)[:, None]
        u, s, vt = np.linalg.svd(factors * root, full_matrices=False)
        keep = s > _LEAST_SHOWN * s[0]
        x = vt[keep].T @ ((u[:, keep].T @ (away * root[:, 0])) / s[keep])
        left = np.abs(away - factors @ x)
        weight = 1 / (1 + (left / max(0.3, 1.5 * float(np.median(left))))**2)**2
    return x, float(np.median(left))


@dataclass(frozen=True)
class Reading:
    """One way to read the cameras' numbers.

    `front`, `inside`: mean shares of the mesh; `seeing`: views that see it; `agreement`: median correlation of
    `patches` patches between pairs of photos, None where fewer than 30 could be compared; `mend`: what to call
    instead; `better`: whether patch by patch the photos significantly prefer it to the cameras as given.
    """

    name: str
    front: float
    inside: float
    seeing: int
    agreement: float | None
    patches: int
    mend: str
    better: bool = False

    def __str__(self) -> str:
        """The agreement, as sentences say it."""
        return "unknown" if self.agreement is None else f"{self.agreement:.2f}"


@dataclass(frozen=True)
class Fit:
    """Where the mesh would have to be for the photos to agree: x -> scale x + offset, scene units.

    `pixels`: how far its patches move by that as other photos see them, median, pixels of parallax; `agreement`: of the
    photos then; `better`: whether that is clearly more than as given, in `better_pairs` of `pairs` pairs of photos;
    `apart`: whether mesh and cameras do not fit together as given.
    """

    scale: float
    offset: tuple[float, float, float]
    pixels: float
    agreement: float
    better: bool
    apart: bool
    better_pairs: int
    pairs: int
    patches: int

    @property
    def correction(self) -> str:
        """What to do with the mesh."""
        scaled = f"scaled by {self.scale:.6g}" if abs(self.scale - 1) > 1e-6 else ""
        moved = "moved by (" + ", ".join(f"{x:.5g}" for x in self.offset) + ")" if any(self.offset) else ""
        return f"{scaled} (about the origin) and then {moved}" if scaled and moved else scaled or moved

    @property
    def how_sure(self) -> str:
        share = self.better_pairs / max(1, self.pairs)
        few = self.pairs < _FEW_PAIRS or self.patches < _FEW_PATCHES
        if not self.better:
            return (f"{'not sure' if few else 'sure'}: {self.patches} patches in {self.pairs} pairs of photos; the "
                    f"mesh is off by {self.pixels:.1f} pixels of parallax")
        word = "a guess" if few or share < _LIKELY else "sure" if share >= _SURE else "likely"
        return f"{word}: {self.better_pairs} of {self.pairs} pairs of photos say so"


def clearly_better(agreement: float, given: float) -> bool:
    """Whether photos agree so much better than they do with what was `given`, both as correlations."""
    return 1 - agreement < _CLEARLY * (1 - given)


def fitted(alignment: Alignment, start: Alignment, middle: np.ndarray, old: np.ndarray, new: np.ndarray,
           given: float | None, prefers: bool) -> Fit:
    """The Fit of an alignment that was found from `start`; `old`, `new`: correlations of the patches (pairs, few) as
    given and then, `given`: their median as given, None = unknown; `middle` of the mesh (3,)."""
    agreement, there = float(np.nanmedian(new)), start.scale == 1 and not start.offset.any()
    known = [row for row in new - old if np.isfinite(row).any()]
    better = prefers and agreement > GOOD and clearly_better(agreement, given or 0.0)
    if start.scale != 1 and alignment.pixels < 0.5:     # a unit alone
        alignment = Alignment(start.scale, start.offset, alignment.pixels)
    offset = np.where(np.abs(alignment.offset) > 1e-9 * np.abs(middle).max(initial=0), alignment.offset, 0.0)
    apart = better and (not there or alignment.pixels >= _APART or (given or 0.0) < GOOD)
    return Fit(float(alignment.scale), (float(offset[0]), float(offset[1]), float(offset[2])), alignment.pixels,
               agreement, better, apart, sum(float(np.nanmedian(row)) > 0 for row in known), len(known),
               int(np.isfinite(new).sum()))


def sentence(given: Reading, best: Reading, count: int, fit: Fit | None, halves: Sequence[Reading], mend: str) -> str:
    """The answer; `mend`: what mends the reading `best`; `halves`: as `half_pixel` takes them."""
    behind = "; the mesh lies behind them" if given.front < 0.05 else ""
    sees = f"{given.seeing} of {count} cameras see the mesh{behind}"
    if best is not given and best.seeing and not given.seeing:
        agree = "" if best.agreement is None else f", and the photos agree ({best})"
        return f"{sees}; {best.name}, {best.seeing} of {count} do{agree}: {mend}"
    if best is not given:
        return (f"photos agree better over the mesh with the cameras {best.name} ({best} instead of {given}): "
                f"{mend}")
    if fit and fit.apart:
        instead = f", as given only {given}" if given.agreement is not None else ""
        apart = (", but mesh and cameras do not fit together:" if given.seeing else
                 ", in no reading of their numbers: cameras and mesh are in different coordinate frames or units;")
        return (f"{sees}{apart} with the mesh {fit.correction} the photos agree "
                f"{fit.agreement:.2f}{instead} ({fit.how_sure})" + (
                    "; is it in another unit than the cameras?" if abs(np.log(fit.scale)) > 0.5 else ""))
    if given.seeing == 0:
        return (f"{sees}, in no reading of their numbers: cameras and mesh are in different coordinate frames or units "
                "(align them first), or the mesh belongs to another scene")
    if given.agreement is None:
        return f"{sees}; too few textured patches are seen by two photos to say more"
    if given.agreement < GOOD:
        return (f"{sees}, but the photos agree only {given} over it, and no other reading of the cameras does better: "
                "is the mesh coarse, are cameras some pixels off ('pagas-cl cameras' measures it), are photos and "
                "cameras paired rightly, do the photos fit together?")
    if fit and fit.better:
        return (f"{sees}, and the photos agree over it ({given}), with the mesh {fit.correction} better "
                f"({fit.agreement:.2f}; {fit.how_sure}): that is {fit.pixels:.1f} pixels of parallax, which a "
                "refinement mends")
    sure = f" ({fit.how_sure})" if fit else ""
    if any(half.better for half in halves[1:]):
        return f"{sees}, and the photos agree over it ({given}): the poses are right, the pixel centres not{sure}"
    if given.agreement < WELL:
        return (f"{sees}, and the photos agree over it ({given}), with no other reading of the cameras better{sure}: "
                "the mesh may be coarse, or cameras a pixel or more off ('pagas-cl cameras' measures it)")
    return f"{sees}, and the photos agree over it ({given}): the cameras are right as they are{sure}"


def half_pixel(readings: Sequence[Reading], fit: Fit | None, mends: Mapping[str, str]) -> str:
    """What the photos say of pixel centres; `readings`: as given, or as the mesh fits best, first; `mends`: by name."""
    if fit and fit.apart:
        return "pixel centres: not judged, since mesh and cameras do not fit together"
    found = [r for r in readings if r.name.startswith("half a pixel") and r.agreement is not None]
    given = readings[0].agreement
    if not found or given is None:
        return "pixel centres: not compared, since no two photos could be"
    agreements = ", ".join([f"as given {given:.4f}", *(f"{r.name} {r.agreement:.4f}" for r in found)])
    better = [r for r in found if r.better]
    if better:
        best = max(better, key=lambda r: r.agreement or 0.0)
        return (f"pixel centres: the photos prefer {best.name} ({agreements}); if K came from a program that counts "
                f"so, {mends[best.name]}")
    return (f"pixel centres: the photos do not show a shift ({agreements}); a shift that all views share hardly "
            "shows unless cameras are rolled against each other")
