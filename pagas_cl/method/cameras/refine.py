"""Refine cameras by the photos and a first surface: `refine_cameras` (method section 9)."""

import time
from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from pagas_cl.config import Config
from pagas_cl.config.presets import settings_of
from pagas_cl.errors import InputError, log
from pagas_cl.method.cameras.accept import bent, no_gain, no_promise, outlier_views, pairs_failed, too_far, wrong_views
from pagas_cl.method.cameras.adjust import Adjuster, MakeBlocks, blocks
from pagas_cl.method.cameras.frames import Frames, depths_of
from pagas_cl.method.cameras.motion import pixel_motion, surface_points
from pagas_cl.method.cameras.pairs import choose_pairs
from pagas_cl.method.cameras.rounds import COARSE, FINE, MAPS, Rounds, Stage, State
from pagas_cl.method.effects.measure import measure
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.surface import depth_alignment as alignment
from pagas_cl.progress import Reporter, progress_of
from pagas_cl.runtime.device import Device, open_device, translate_cl_errors
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.scene.depth.source import rescaled
from pagas_cl.scene.inputs import Depth, check_maps, check_one_each, depth_maps
from pagas_cl.scene.mesh import Mesh
from pagas_cl.scene.sampling import evenly
from pagas_cl.scene.view import View, checked_views

UNKNOWNS = ("pose", "focal", "principal_point", "depth_scale", "depth_shift")
OFF = 0.05                # epipolar residual, pixels, from which on pairs that take no part decide whether cameras are
                          # refined: right ones have 0.02 to 0.03 where depth is nearly right (made scenes),
CLEARLY_OFF = 0.13        # and from which on they are in any case
FAR = 0.8                 # the same from which coarse photos come first
_FAR_OFF = 0.15           # share of samples that match two or more pixels away from which on they do, too
_FINEST = 640_000         # pixels of a photo at the finest size: more say the same of a camera
_WIDE = 0.25              # of the finest size: views far apart are off by too many pixels for fine detail
_MEASURED = 4             # views that are measured


@dataclass(frozen=True, eq=False)
class CameraRefinement:
    """Refined cameras, and what speaks for them."""

    cameras: list[Camera]
    """One a view, in their order; the given ones where they were not accepted."""
    accepted: bool
    reason: str
    """Why the cameras stay as they were given; empty where they were refined."""
    moved: np.ndarray = field(repr=False)
    """Pixels that each photo moved by, root mean square over its surface, float64 (N,), accepted or not; NaN where a
    view has no surface."""
    pairs: list[tuple[str, str, float, float]] = field(default_factory=list, repr=False)
    """Pairs of views that took no part: names, mean residual cost before and after."""
    left_out: tuple[str, ...] = ()
    """Views whose camera is wrong as a whole (its photo shows something else than the others' surface), which took no
    part and keep their camera."""
    depth_scales: np.ndarray | None = field(default=None, repr=False)
    """Scale (and `depth_shifts`, shift in scene units) of each view's depth map, (N,): depth = scale * given + shift.
    None where they stay: no unknowns, and of the scale that the cameras have."""
    depth_shifts: np.ndarray | None = field(default=None, repr=False)
    report: dict[str, Any] = field(default_factory=dict, repr=False)
    """Plain numbers: off (pixels), rounds, residual before and after, seconds."""

    def __str__(self) -> str:
        wrong = f"; wrong, and therefore unchanged: {', '.join(self.left_out)}" if self.left_out else ""
        if not self.accepted:
            return f"cameras stay unchanged: {self.reason}{wrong}"
        scales = self.depth_scales
        scaled = "" if scales is None else f"; depth maps scaled by {np.median(scales):.4f} (median)"
        return (f"cameras were off and are corrected: by {np.nanmedian(self.moved):.2f} pixels in the typical photo, "
                f"at most {np.nanmax(self.moved):.2f}{scaled}{wrong}")

    def scaled(self, depths: Sequence[Any]) -> list[Any]:
        """Depth maps, or what loads them, with these scales and shifts; the same objects where they stay. InputError:
        not one a camera."""
        check_one_each(depths, len(self.cameras))
        scales, shifts = self.depth_scales, self.depth_shifts
        return list(depths) if scales is None or shifts is None else [
            rescaled(depth, float(a), float(b)) for depth, a, b in zip(depths, scales, shifts)]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"accepted": self.accepted, "reason": self.reason, "left_out": list(self.left_out), "moved":
                {camera.name: round(float(m), 4) if np.isfinite(m) else None
                 for camera, m in zip(self.cameras, self.moved)},
                "held_back_pairs": [{"views": [a, b], "before": before, "after": after}
                                    for a, b, before, after in self.pairs], **self.report}


def refine_cameras(views: Sequence[View], depths_or_mesh: Sequence[Depth | None] | Mesh, *,
                   unknowns: Collection[str] = ("pose",), lenses: Sequence[int] | None = None,
                   gauge: Sequence[Camera] | None = None, measured: tuple[float, float] | None = None,
                   preset: str | None = None, config: Config | None = None, device: Any = None,
                   progress: Reporter = None, photos: PhotoStore | None = None,
                   make_blocks: MakeBlocks = blocks) -> CameraRefinement:
    """Refine the cameras of `views`, so that their photos agree through the surface.

    Parameters
    ----------
    views : list of View
    depths_or_mesh : list of arrays (H, W), one a view (None where it has none), or a mesh as in refine_mesh
        The surface as it is known. Depth maps go with their views; a mesh stays where it is.
    unknowns : collection of str
        Of "pose"; "focal" and "principal_point", shared by the views of one lens; "depth_scale" and "depth_shift", of
        each view's depth map (not of a mesh).
    lenses : list of int, optional
        For each view the number of its lens, from 0; by default views of equal focal lengths and sizes share one.
    gauge : list of Camera, optional
        The cameras that hold what photos do not see, where `views` have been refined before: those given at first.
    measured : (float, float), optional
        Epipolar residual of the photos, pixels, and the share of samples that match at other pixels, where these are
        to decide: below CLEARLY_OFF half of the size comes first, and the rest only where it gains. Measured, and all
        done, by default.
    device
        As in refine_depth.
    make_blocks : callable, optional
        What adds up the normal equations of views: `blocks`, or other processes.

    Returns
    -------
    CameraRefinement
        Accepted only where pairs of photos that took no part agree better (neighbours) and no worse (views far apart).

    Raises
    ------
    InputError, DeviceError
    """
    device, config, views = open_device(device), settings_of(preset, config), checked_views("views", views)
    unknowns = (unknowns,) if isinstance(unknowns, str) else tuple(unknowns)
    with translate_cl_errors(device, "the refinement of the cameras"):
        start, (depths, moves) = time.perf_counter(), depths_of(depths_or_mesh, device)
        _check(views, depths_or_mesh, unknowns, moves, gauge)
        given, photos = [view.camera for view in views], photos or PhotoStore(device)
        surfaces = depths(given)
        unchanged = partial(CameraRefinement, given, False, moved=np.full(len(views), np.nan))
        samples = [surface_points(camera, depth) for camera, depth in zip(given, surfaces)]
        typical = [float(np.median(z)) if len(z) else np.nan for _, z in samples]
        if not np.isfinite(typical).any():
            return unchanged("no view has a surface")
        scene_scale = float(np.nanmedian(typical))
        typical = [z / scene_scale if np.isfinite(z) else 1.0 for z in typical]
        pairs = choose_pairs(given, surfaces, config.context, hide=not _map_numbers(unknowns))
        if not pairs.held or sum(map(bool, pairs.used)) < 3:
            return unchanged("it takes four views that see the same surface: three to measure how far a camera is off, "
                             "and one more to judge")
        off, far_off = measured or photos_off(views, surfaces, config, device, photos)
        adjuster = Adjuster(device, scene_scale, intrinsics=unknowns != ("pose",))
        finest = min(1.0, float(np.sqrt(_FINEST / np.median([c.width * c.height for c in given]))))
        frames = Frames(adjuster, views, depths, moves, photos, finest)
        numbers = ((0,) if "focal" in unknowns else ()) + ((1, 2) if "principal_point" in unknowns else ())
        state = State(list(gauge or given), list(given), np.tile([1.0, 0.0], (len(views), 1)), max(off, 0.3),
                      _lenses(given, unknowns, lenses), numbers, _map_numbers(unknowns))
        rounds = Rounds(frames, pairs, typical, progress_of(progress), make_blocks)
        if measured and off < CLEARLY_OFF and (reason := no_promise(rounds, state.copy())):
            found = unchanged(reason, report={"off": off, "far_off": far_off})
        else:
            coarse = off > FAR or far_off > _FAR_OFF
            rounds, state, wrong, report = _better_attempt(rounds, state, surfaces, coarse)
            found = _judged(views, given, rounds, state, wrong, samples, {
                "off": off, "far_off": far_off, **report, "rounds": state.log})
        found.report["seconds"] = time.perf_counter() - start
        return found


def photos_off(views: Sequence[View], depths: Sequence[np.ndarray | None], config: Config, device: Device,
               photos: PhotoStore) -> tuple[float, float]:
    """Epipolar residual of the photos, pixels (root mean square over some of the views), and the share of samples that
    match at other pixels."""
    have = [k for k, depth in enumerate(depths) if depth is not None and (depth > 0).any()]
    chooser = PartnerChooser([view.camera for view in views], list(depths), config.context)
    found = []
    for k in [have[n] for n in evenly(len(have), _MEASURED)]:
        partners = chooser.choose(k)
        if partners.contexts:
            given = ViewInput(views[k], [views[j] for j in partners.contexts], depths[k], device, photos)
            found.append(measure(given, config))
    if not found:
        return 0.0, 0.0
    return (float(np.sqrt(np.mean([one.misaligned**2 for one in found]))),
            float(np.mean([one.far_off for one in found])))


def _better_attempt(rounds: Rounds, state: State, surfaces: Sequence[np.ndarray],
                    coarse: bool) -> tuple[Rounds, State, set[int], dict[str, Any]]:
    """The rounds from `state`, from small photos on where they are needed (`coarse`), or once more from initial
    rotations where that leaves fewer views out of place: with the state after them, the views whose cameras are wrong,
    and for the report whether they were coarse, and by how many pixels whole photos were offset."""
    again, given = copy(rounds), list(state.cameras)
    if state.map_numbers:
        small = [alignment.reduced(camera, depth) for camera, depth in zip(given, surfaces)]
        first_maps = alignment.solve(alignment.Overlaps.of(small))
        state.maps[:, 0] = np.exp(first_maps[:, 0]) + first_maps[:, 1]        # in the middle of the depth
        rounds.run(MAPS, state)
    first, outliers = state.copy(), wrong_views(rounds, state, 0.25)
    coarse = bool(coarse or state.map_numbers or outliers)
    wrong, offset = _run(rounds, COARSE if coarse else FINE, state, given), 0.0
    left = _left(rounds, state, wrong)
    far = left[0] or bool(wrong - outliers)
    if far or left[-1]:                                # farther off than coarse photos reach
        first.cameras, pixels = again.rotated(first, 0.25)
        others, offset = _run(again, COARSE, first, given), pixels if far else 0.0
        if _left(again, first, others) < left:
            rounds, state, wrong = again, first, others
    return rounds, state, wrong, {"coarse": coarse, "photo_offset": offset}


def _left(rounds: Rounds, state: State, wrong: set[int]) -> tuple[bool, int, int]:
    """What is not in its place yet, the worst first."""
    return pairs_failed(rounds, state), len(wrong), len(outlier_views(rounds, state))


def _run(rounds: Rounds, stages: Sequence[Stage], state: State, given: Sequence[Camera]) -> set[int]:
    """All stages; once more without the views that turn out to be wrong, which are returned and stay as given."""
    rounds.run(stages, state)
    wrong = wrong_views(rounds, state)
    if wrong:                                          # the others once more, without what misled them
        rounds.pairs = rounds.pairs.without(wrong)
        state.cameras = [given[k] if k in wrong else camera for k, camera in enumerate(state.cameras)]
        rounds.run(COARSE, state)
        state.cameras = [given[k] if k in wrong else camera for k, camera in enumerate(state.cameras)]
    return wrong


def _judged(views, given, rounds, state, wrong, samples, report) -> CameraRefinement:
    """Whether pairs that took no part agree better: neighbours, and those far apart."""
    neutral = np.tile([1.0, 0.0], (len(views), 1))

    def costs_of(pairs, share):
        """Names, costs (n, 2) and pixels seen (n, 2), before and after, of pairs that see the same surface in both."""
        both = np.stack([rounds.judged(cameras, maps, pairs, share) for cameras, maps in
                         ((given, neutral), (state.cameras, state.maps))], -1)
        known = np.isfinite(both[:, 0]).all(axis=-1)
        names = [(views[one].name, views[two].name) for (one, two), k in zip(pairs, known) if k]
        return names, both[known, 0], both[known, 1].sum(axis=0), both[known, 2, 1]

    names, costs, seen, offset_costs = costs_of(rounds.pairs.held, 1.0)
    held_back = [(*pair, float(a), float(b)) for pair, (a, b) in zip(names, costs)]
    wide_names, wide, wide_seen, _ = costs_of(rounds.pairs.wide, _WIDE)
    moved = np.array([pixel_motion(old, new, points) if len(points) else np.nan
                      for old, new, (points, _) in zip(given, state.cameras, samples)])
    reason = (too_far(costs[:, 1], offset_costs, len(wrong) / len(views), report["photo_offset"], given[0].width)
              or no_gain(costs, *seen) or bent(wide, *wide_seen))
    maps = not reason and (state.map_numbers > 0 or bool((state.maps != neutral).any()))
    report |= {"cost_before": float(costs[:, 0].mean()) if len(costs) else None,
               "cost_after": float(costs[:, 1].mean()) if len(costs) else None, "spread": state.spread,
               "wide_pairs": [{"views": pair, "before": a, "after": b}
                              for pair, (a, b) in zip(wide_names, wide.tolist())]}
    left_out = tuple(views[k].name for k in sorted(wrong))
    for name in left_out:
        log.warning("the camera of view %s is wrong: its photo does not fit the surface that the others see; align it "
                    "again, or leave it out with --hold-out", name)
    return CameraRefinement(given if reason else state.cameras, not reason, reason, moved, held_back, left_out,
                            state.maps[:, 0] if maps else None,
                            state.maps[:, 1] * rounds.scene_scale if maps else None, report)


def _lenses(cameras: Sequence[Camera], unknowns, given) -> tuple[int, ...]:
    if not {"focal", "principal_point"} & set(unknowns):
        return ()
    if given is not None:
        if len(given) != len(cameras):
            raise InputError(f"lenses has {len(given)} numbers, expected one for each of the {len(cameras)} views")
        return tuple(int(k) for k in given)
    keys = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras]
    return tuple(sorted(set(keys)).index(key) for key in keys)


def _map_numbers(unknowns) -> int:
    return 2 if "depth_shift" in unknowns else 1 if "depth_scale" in unknowns else 0


def _check(views, depths, unknowns, moves: bool, gauge) -> None:
    for name in unknowns:
        if name not in UNKNOWNS:
            raise InputError(f"unknowns has {name!r}, expected some of {', '.join(UNKNOWNS)}")
    if moves and _map_numbers(unknowns):
        raise InputError("depth_scale is an unknown of depth maps, and a mesh was given; give depth maps instead")
    if not moves:
        for view, depth in zip(views, depth_maps(views, depths)):
            if isinstance(depth, np.ndarray):
                check_maps([view.camera], [depth], f"depth map of view {view.name!r}")
    if gauge is not None and len(gauge) != len(views):
        raise InputError(f"gauge has {len(gauge)} cameras, expected one for each of the {len(views)} views")
