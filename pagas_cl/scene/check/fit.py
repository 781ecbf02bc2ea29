"""What the camera check says: which reading of the cameras, where the mesh would have to be, and how sure that is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pagas_cl.scene.check.align import Alignment

GOOD = 0.5           # correlation of photos that agree
_CLEARLY = 0.8       # of 1 - correlation as given: a fit that leaves more is none
_APART = 1.0         # pixels of parallax; a mesh that is off by less is for the refinement to mend
_SURE, _LIKELY = 0.9, 2 / 3     # shares of the pairs of photos that say the same
_FEW_PAIRS, _FEW_PATCHES = 3, 200


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
        """How sure it is that this is better, or that nothing is."""
        share = self.better_pairs / max(1, self.pairs)
        few = self.pairs < _FEW_PAIRS or self.patches < _FEW_PATCHES
        if not self.better:
            return (f"{'not sure' if few else 'sure'}: {self.patches} patches in {self.pairs} pairs of photos; the "
                    f"mesh is off by {self.pixels:.1f} pixels of parallax")
        word = "a guess" if few or share < _LIKELY else "sure" if share >= _SURE else "likely"
        return f"{word}: {self.better_pairs} of {self.pairs} pairs of photos say so"


def fitted(alignment: Alignment, start: Alignment, middle: np.ndarray, old: np.ndarray, new: np.ndarray,
           given: float | None, prefers: bool) -> Fit:
    """The Fit of an alignment that was found from `start`; `old`, `new`: correlations of the patches (pairs, few) as
    given and then, `given`: their median as given, None = unknown; `middle` of the mesh (3,)."""
    agreement, there = float(np.nanmedian(new)), start.scale == 1 and not start.offset.any()
    known = [row for row in new - old if np.isfinite(row).any()]
    better = prefers and agreement > GOOD and (1 - agreement) < _CLEARLY * (1 - (given or 0.0))
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
                "is the mesh coarse, are photos and cameras paired rightly, do the photos fit together?")
    if fit and fit.better:
        return (f"{sees}, and the photos agree over it ({given}), with the mesh {fit.correction} better "
                f"({fit.agreement:.2f}; {fit.how_sure}): that is {fit.pixels:.1f} pixels of parallax, which a "
                "refinement mends")
    sure = f" ({fit.how_sure})" if fit else ""
    if any(half.better for half in halves[1:]):
        return f"{sees}, and the photos agree over it ({given}): the poses are right, the pixel centres not{sure}"
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
