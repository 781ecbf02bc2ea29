"""Initial depth maps before anything is refined: is their unit that of the cameras, do they agree, what mends it.

Unit (photos) -> a factor and a shift a view (depth maps) -> the factor of all (photos). Each is applied only where the
evidence is clear, and said."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pagas_cl.method.surface import common_scale
from pagas_cl.method.surface import depth_alignment as alignment
from pagas_cl.method.surface.common_scale import WELL, CommonScale
from pagas_cl.method.surface.photo_sweep import AGREE, Greys
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.source import adjusted, rescaled
from pagas_cl.scene.depthmap import depth_down, surface_depth
from pagas_cl.scene.inputs import Depth, check_one_each, depth_array, depth_maps
from pagas_cl.scene.view import View, checked_views

_HELD, _FEW = 400, 200        # pixels of the longer side of the maps that are kept in memory, of so many views
_BETTER = 0.7                 # disagreement must fall to this share of it
_MATTERS = 0.004              # and some depth must change by this share
_SAME = 0.1 * _MATTERS        # maps that disagree by less are left as they are
ALONE, REACH = 0.5, 4.0       # pixels that a refinement bridges while cameras stay, and where they are refined first
_STILL = 0.05                 # a view that disagrees by more afterwards is named
_CLEARLY = 0.1                # by so much photos must agree better over maps that are read otherwise
_READINGS = {                 # what maps may hold by mistake, and what to do
    "distances along rays, not z-depth (divide each by the length of its pixel's ray, whose z is 1)":
        lambda values, camera: values / np.linalg.norm(camera.rays(), axis=-1),
    "inverse depth, not z-depth (take one over each)": lambda values, camera: 1 / np.where(values > 0, values, np.inf),
    "rows from the bottom up (turn each upside down)": lambda values, camera: values[::-1]}
_UNITS = {1e3: " (millimetres and metres)", 1e-3: " (metres and millimetres)", 1e2: " (centimetres and metres)"}


@dataclass(frozen=True, eq=False)
class DepthScales:
    """What is to be done: depth of view k times `factors[k]` plus `shifts[k]` scene units; both (views,) float64.

    `unit`: the number for one scene unit that is part of the factors; `disagreement`: median relative difference of
    depth maps where two views see the same, before and after; `agreement`: correlation of photos over the depth, NaN
    where it could not be measured; `off`: epipolar residual of the photos, pixels (0 where they agree well); `said`:
    all of it in sentences.
    """

    factors: np.ndarray = field(repr=False)
    shifts: np.ndarray = field(repr=False)
    unit: float = 1.0
    disagreement: tuple[float, float] = (0.0, 0.0)
    agreement: float = float("nan")
    off: float = 0.0
    said: tuple[str, ...] = ()

    def apply(self, depths: Sequence[Any]) -> list[Any]:
        """Depth maps, or what loads them, with it done; the same objects where they stay. InputError: not one a
        view."""
        check_one_each(depths, len(self.factors))
        return [rescaled(depth, float(a), float(b)) for depth, a, b in zip(depths, self.factors, self.shifts)]


def align_depth_scales(views: Sequence[View], depths: Sequence[Depth | None],
                       unit_is_known: bool = False) -> DepthScales:
    """Find factors and shifts under which the initial depth maps of `views` (None where a view has none) agree.

    `unit_is_known`: their unit is not looked for. Deterministic; a few maps are loaded at a time. InputError: not a
    depth map, or None, a view.
    """
    views = checked_views("views", views)
    depths = depth_maps(views, depths)
    held = side_by_side(lambda k: _small(views[k], depths[k], len(views)), range(len(views)))
    cameras = [view.camera if map is None else view.camera.resized(map.shape[1], map.shape[0])
               for view, map in zip(views, held)]
    have = [k for k, map in enumerate(held) if map is not None and (map > 0).any()]
    greys = Greys(views)
    factors, shifts, said = np.ones(len(views)), np.zeros(len(views)), list[str]()
    if not have or len(views) < 2:
        return DepthScales(factors, shifts)
    unit = 1.0
    if not unit_is_known:
        unit, agreement, given = common_scale.find_unit(greys, held)
    if unit != 1:
        said.append(f"depths are {unit:g} times as large as the cameras' positions require{_UNITS.get(unit, '')}: "
                    f"photos agree {agreement:.2f} over the depths divided by that, {given:.2f} over them as they are; "
                    "they are divided")
        factors[have] /= unit
        held = [None if map is None else map / np.float32(unit) for map in held]
    read = list(held)
    small = side_by_side(lambda k: alignment.reduced(cameras[k], held[k]), have)       # type: ignore[arg-type]
    x, before, after, left = _aligned(small)
    if x is not None:
        own = np.exp(x[:, 0])
        shift = x[:, 1] * [view.middle for view in small]
        factors[have] *= own
        shifts[have] = shift
        said.append(f"depth maps disagreed by {before:.1%} (median, where two views see the same); factors of "
                    f"{own.min():.3f} to {own.max():.3f} and shifts of {x[:, 1].min():+.1%} to {x[:, 1].max():+.1%} of "
                    f"the depth, a pair a view, bring them to {after:.1%}")
        for k, a, b in zip(have, own, shift):
            held[k] = adjusted(held[k], float(a), float(b))       # type: ignore[arg-type]
    common = common_scale.find_common_scale(greys, held, x is None)      # maps that disagreed know no scale
    if common.factor != 1:
        factors[have] *= common.factor
        shifts[have] = shifts[have] * common.factor + common.shift
        more = f", and {common.shift:.4g} is added" if common.shift else ""
        said.append(f"all depths are multiplied by {common.factor:.4f}{more}: photos agree {common.agreement:.2f} over "
                    f"them then, {common.given:.2f} before")
        held = [None if map is None else adjusted(map, common.factor, common.shift) for map in held]
    off = common_scale.cameras_off(greys, held) if common.agreement < WELL else 0.0
    misread = [] if common.given >= WELL else _misread(greys, cameras, read, common.agreement)
    said += misread or _doubts([views[have[k]].name for k in left], common, off)
    return DepthScales(factors, shifts, unit, (before, after), common.agreement, off, tuple(said))


def _misread(greys: Greys, cameras: Sequence[Camera], maps: Sequence[np.ndarray | None], agreement: float) -> list[str]:
    """What the maps hold if photos agree well, and clearly better than `agreement`, over another reading of them."""
    for what, depth_of in _READINGS.items():
        depths = [None if map is None else surface_depth(depth_of(map, camera)) for map, camera in zip(maps, cameras)]
        found = common_scale.agreement_over(greys, depths)
        if found > max(WELL, np.nan_to_num(agreement) + _CLEARLY):
            return [f"depth maps hold {what}: photos agree {found:.2f} over them read so, "
                    f"{np.nan_to_num(agreement):.2f} as they are; results are wrong until the maps are converted"]
    return []


def _small(view: View, depth: Depth | None, count: int) -> np.ndarray | None:
    if depth is None:
        return None
    depth, side = depth_array(depth), _HELD if count <= _FEW else alignment.SIDE
    scale = min(1.0, side / max(depth.shape))
    return depth_down(depth, *view.camera.size.scaled(scale))


def _aligned(small: list[alignment.Reduced]) -> tuple[np.ndarray | None, float, float, list[int]]:
    """The unknowns, None where not needed; disagreement before, after, of other samples; views that still do."""
    maps = alignment.Overlaps.of(small)
    judges, x = maps.some(slice(1, None, 2)), np.zeros((len(small), 2))
    before = after = judges.disagreement(x)
    if _median(before) >= _SAME:
        x = alignment.solve(maps.some(slice(0, None, 2)))
        after = judges.disagreement(x)
    sizes = np.abs(np.exp(x[:, 0]) - 1 + x[:, 1])
    called = _median(after) < _BETTER * _median(before) and sizes.max() > _MATTERS
    now = after if called else before
    left = [k for k in range(len(small)) if _median(now[(maps.pairs == k).any(axis=1)]) > _STILL]
    return (x if called else None), _median(before), _median(now), left


def _median(values: np.ndarray) -> float:
    """Of those that are finite; 0 where none is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _doubts(names: list[str], common: CommonScale, off: float) -> list[str]:
    """What is still wrong, and what to run."""
    said = []
    if names:
        said.append(f"{len(names)} views still disagree with their neighbours by more than {_STILL:.0%}: "
                    + ", ".join(names[:5]) + (", ..." if len(names) > 5 else ""))
    if off > ALONE:
        said.append(f"cameras are off: photos miss one another by about {off:.1f} pixels, whatever the depth. Up to "
                    f"some {REACH:g} pixels are corrected before depth is refined (effect 'cameras'); where they are "
                    "off by more, adjust them first: COLMAP's bundle_adjuster with these as its start, or the "
                    "network's own (VGGT: --use_ba)")
    elif common.agreement < AGREE:
        said.append(f"photos do not fit together over the depth (they agree {common.agreement:.2f}, of 1), and moving "
                    "them by some pixels does not mend it: depth or cameras are far off, or photos and cameras are "
                    "paired wrongly; run COLMAP's bundle adjustment, or give better depth")
    return said
