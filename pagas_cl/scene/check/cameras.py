"""Are these the right cameras for this mesh and these photos? And if not, which reading of their numbers is?

Every reading that people mix up is tried. How much of the mesh each sees, and how well photos agree over the mesh,
decides; what they cannot decide is said. `check_seen`, the part without photos, goes before every refinement.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, log
from pagas_cl.scene.camera import Camera, focus
from pagas_cl.scene.check import fit as sentences
from pagas_cl.scene.check import patches
from pagas_cl.scene.check.conventions import DETAILS, POSES, ROTATED, Change
from pagas_cl.scene.check.fit import GOOD, WELL, Alignment, Fit, Reading, align, clearly_better, fitted
from pagas_cl.scene.inputs import Cameras, Images, as_cameras, as_views
from pagas_cl.scene.mesh import Mesh, Surface
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.sampling import evenly
from pagas_cl.scene.view import View

_SAMPLES = 20_000
_WORK = 20_000_000   # camera-point pairs of one reading of the poses
_PHOTOS = 10         # that are compared
_CHANCE = 0.0005     # share of the mesh that a wrong reading may have in an image by chance; a city's view has more
_MUCH = 0.1          # share of the mesh that images show on the average where its unit is right
_SEES = 0.002        # the same of the fewer samples that photos are compared at
_CLEAR = 0.15        # a pose reading must correlate better by this much
UNITS = (1e-3, 1e-2, 0.0254, 0.1, 0.3048, 1 / 0.3048, 10.0, 1 / 0.0254, 100.0, 1e3)   # metric, inches, feet
_ALL = (*POSES, *ROTATED, *DETAILS)


def check_seen(surface: Surface, cameras: list[Camera]) -> npt.NDArray[np.float64]:
    """Raise InputError when the poses are such that hardly a camera sees the mesh, saying which reading would mend it.
    Returns the share of its points in front of and inside each camera's image, float64 (cameras,)."""
    if not cameras:
        raise InputError("there are no cameras: nothing can be refined")
    points = sample_points(surface, min(_SAMPLES, max(500, _WORK // len(cameras))))
    front, inside = patches.shares(cameras, points)
    seeing, count = int(np.count_nonzero(inside)), len(cameras)
    _warn_of_rounding(surface, cameras, points)
    if 2 * seeing >= count:
        return inside
    by_pose = [patches.shares([way.of(camera) for camera in cameras], points)[1] for way in POSES[1:]]
    by_unit = [patches.shares(cameras, unit * points)[1] for unit in UNITS]
    better = [int(np.count_nonzero(share > _CHANCE)) for share in by_pose]      # cameras that see the mesh then
    seen = [int(np.count_nonzero(share > _CHANCE)) for share in by_unit]
    best = int(np.argmax(better))  # the first of equals: the simplest reading
    behind = int(np.count_nonzero(front < 0.5))
    who = f"{seeing} of {count} cameras see the mesh" + (f", it lies behind {behind} of {count}" if behind else "")
    fitting = [k for k, share in enumerate(by_unit)     # the largest of these is no dot
               if seen[k] >= 0.9 * count and share.mean() > max(_MUCH, 3 * by_pose[best].mean())]
    if fitting and not seeing:
        raise InputError(f"{who}; with the mesh scaled by {UNITS[fitting[-1]]:.4g} {seen[fitting[-1]]} of {count} do: "
                         "is it in another unit than the cameras ('pagas-cl check' finds out by the photos)?")
    if better[best] >= (0.9 * count if seeing else max(1, 0.5 * count)):
        way = POSES[1 + best]
        found = f"{who}; with {way.matrices} {better[best]} of {count} do: "
        error = InputError(f"{found}pass {way.mend.partition('(')[0]}(...)")
        error.at_command_line = f"{found}{way.in_files}"
        raise error
    if seeing == 0:
        centers = np.array([camera.center for camera in cameras])
        raise InputError(f"{who}, nor do more with inverse matrices or OpenGL axes: the mesh spans {_box(points)}, the "
                         f"cameras are at {_box(centers)}; are mesh and cameras in the same frame and unit "
                         "('pagas-cl check' compares by the photos)?")
    return inside


def _warn_of_rounding(surface: Surface, cameras: list[Camera], points: npt.NDArray[np.float64]) -> None:
    """Warn of a mesh at map coordinates that float32 has rounded by more than a pixel that sees its `points`."""
    vertices = surface.vertices[evenly(len(surface.vertices), _SAMPLES)]
    step = float(np.spacing(np.abs(vertices).max().astype(np.float32)))
    if not np.array_equal(vertices, vertices.astype(np.float32)):
        return
    some = [cameras[k] for k in evenly(len(cameras), 20)]
    depths = [z[camera.holds(uv, z)] / camera.fx for camera in some for uv, z in [camera.project(points)]]
    pixel = float(np.median(np.concatenate(depths))) if any(map(len, depths)) else np.inf
    if step > pixel:
        log.warning("the mesh has coordinates of up to %.7g in single precision, 7 digits: steps of %.3g units, %.2g "
                    "pixel footprints, to which its shape is rounded; write it in double precision, or with mesh and "
                    "cameras moved near the origin", np.abs(vertices).max(), step, step / pixel)


def sample_points(surface: Surface, count: int) -> npt.NDArray[np.float64]:
    """Up to `count` vertices, evenly taken, and as many points on the faces, by area: float64 (N, 3)."""
    vertices = surface.vertices
    return np.concatenate([vertices[evenly(len(vertices), count)],
                           patches.spread_over(vertices, surface.faces, count)[0]])


def _box(places: np.ndarray) -> str:
    return " to ".join(f"({', '.join(f'{v:.4g}' for v in end)})" for end in (places.min(axis=0), places.max(axis=0)))


@dataclass(frozen=True)
class ViewCheck:
    """Shares of the mesh's area in front of a view and inside its image."""

    name: str
    front: float
    inside: float


@dataclass(frozen=True)
class CameraReport:
    """What `check_cameras` found.

    `ok`: the cameras as given see the mesh, are the best reading, and fit to it; `sentence`: what is wrong, what mends
    it and how sure that is, or that nothing is; `half_pixel`: what the photos say about pixel centres; `readings`: as
    given first; `fit`: where the mesh would have to be for the photos to agree, None where that is not known.
    """

    ok: bool
    sentence: str
    half_pixel: str
    best: str
    readings: tuple[Reading, ...]
    views: tuple[ViewCheck, ...]
    fit: Fit | None = None
    at_command_line: tuple[str, str] = ("", "")
    """`half_pixel` and `sentence` for who mends files and not calls."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def check_cameras(mesh: Mesh, cams: Cameras, images: Images | None = None) -> CameraReport:
    """Check cameras against a mesh and photos, all as `refine_mesh` takes them.

    Without photos only what each view sees of the mesh is compared.
    """
    if images is None:
        return check_views(mesh, as_cameras(cams), None)
    views = as_views(cams, images)
    return check_views(mesh, [view.camera for view in views], views)


def check_views(mesh: Mesh, cams: list[Camera], views: list[View] | None) -> CameraReport:
    """The same for a scene's views; at most _PHOTOS of their photos are decoded at a time: evenly chosen of all, else,
    where these have too little in common (a long strip), a group of those that see the mesh. Where photos do not agree
    over its area, nearly all of which may be a dome around the scene, they are compared over its triangles alike."""
    if not cams:
        raise InputError("no cameras were given, expected at least one")
    surface = to_surface(mesh)
    samples = patches.sample_surface(surface)
    if not samples.few:
        raise InputError("the mesh has no area: all its triangles are degenerate")
    _warn_of_rounding(surface, cams, samples.points)
    report = _checked(samples, cams, views, surface)
    seeing = [k for k, view in enumerate(report.views) if view.inside]
    if views is None or not report.ok or report.readings[0].agreement is not None or report.fit:
        return report
    for group in patches.groups([cams[k] for k in seeing], _PHOTOS):
        keep = [seeing[k] for k in group]
        some = [cams[k] for k in keep]
        found = _checked(patches.sample_surface(surface, seen_by=some), some, [views[k] for k in keep])
        if found.readings[0].agreement is not None or found.fit:
            (half, sentence), ends = found.at_command_line, [views[keep[end]].name for end in (0, -1)]
            head = f"compared were {len(keep)} of {len(cams)} photos, {ends[0]!r} to {ends[1]!r}: "
            return replace(found, views=report.views, sentence=head + found.sentence,
                           at_command_line=(half, head + sentence))
    return report


def _checked(samples: patches.Samples, cams: list[Camera], views: list[View] | None,
             surface: Surface | None = None) -> CameraReport:
    """The report on samples of a mesh; or on others of `surface`, over which photos agree where they do not over these.
    """
    keep = evenly(len(cams), _PHOTOS)
    greys = None if views is None else [patches.grey_of(views[k].load_image()) for k in keep]
    given = every = _Trial(POSES[0], cams, keep, greys, samples)
    if greys is not None and surface is not None and (given.reading(given).agreement or 0.0) < GOOD:
        seen = patches.sample_surface(surface, seen_by=[cams[k] for k in keep], alike=True)
        other = _Trial(POSES[0], cams, keep, greys, seen) if seen.few else given
        if (other.reading(other).agreement or 0.0) >= GOOD:
            given, samples = other, seen
    rotated = ROTATED if (given.reading(given).agreement or 0.0) < GOOD else ()
    trials = [given, *(_Trial(way, cams, keep, greys, samples) for way in (*POSES[1:], *rotated))]
    if given.pairs:
        trials.append(_Trial(DETAILS[0], cams, keep, greys, samples, given))
    readings = [trial.reading(given) for trial in trials]
    best, fit, halves, at = _best(readings, len(cams)), None, [readings[0]], given
    # of a flat scene at the origin a mesh that is off agrees a little better turned over
    unsure = best.name in [way.name for way in ROTATED] and (best.agreement or 0.0) < WELL
    if greys is not None and (best is readings[0] or unsure):
        fit, moved = _fit([cams[k] for k in keep], greys, samples, bool(given.pairs), readings[0], cams)
        if best is readings[0] or fit and fit.apart and fit.agreement > (best.agreement or 0.0):
            best, at = readings[0], given if moved is None else _Trial(POSES[0], cams, keep, greys, moved)
        else:
            fit = None
    if at.pairs:
        halves = [trial.reading(at) for trial in (at, *(_Trial(way, cams, keep, greys, at.samples, at)
                                                        for way in DETAILS[1:]))]
    checks = tuple(ViewCheck(camera.name or f"view {i}", float(f), float(n))
                   for i, (camera, f, n) in enumerate(zip(cams, every.front, every.inside)))
    answers = []        # for who mends calls, and for who mends files
    for mends in ({way.name: f"use {way.mend}" for way in _ALL}, {way.name: way.in_files for way in _ALL}):
        answers.append((sentences.half_pixel(halves, fit, mends),
                        sentences.sentence(readings[0], best, len(cams), fit, halves, mends[best.name])))
    right = best is readings[0] and best.seeing > 0 and not (fit and fit.apart)
    readings += [replace(half, better=half.better and not (fit and fit.apart)) for half in halves[1:]]
    (half, sentence), at_command_line = answers
    return CameraReport(right, sentence, half, best.name, tuple(readings), checks, fit, at_command_line)


def _fit(cameras: list[Camera], greys: list[np.ndarray], samples: patches.Samples, compared: bool, given: Reading,
         every: list[Camera]) -> tuple[Fit | None, patches.Samples | None]:
    """Where the mesh would have to be for the photos to agree best, and its samples there. Where they do not agree
    as given, other units are tried too, and the mesh moved to where the cameras look."""
    starts = [Alignment()] if compared else []
    if (given.agreement or 0.0) < GOOD:
        starts += [Alignment(unit) for unit in UNITS[::-1]]      # a dot may agree by chance: the largest first
        starts.append(Alignment(1.0, focus(cameras) - samples.points.mean(axis=0)))
    found: list[tuple[Fit, patches.Samples]] = []
    for start in starts:
        at_start = start.of(samples)
        if 2 * np.count_nonzero(patches.shares(every, at_start.points)[1] > _SEES) < len(every):
            continue
        alignment = align(cameras, greys, samples, start)
        if alignment is None:
            continue
        moved, same = alignment.of(samples), start.scale == 1 and not start.offset.any()
        seen, theirs = patches.overlaps(cameras, moved)
        new = patches.patch_correlation(cameras, greys, theirs, seen, moved)
        if np.isfinite(new).sum() < patches.LEAST:
            continue
        old = patches.patch_correlation(cameras, greys, theirs, seen, samples) if same else np.full_like(new, -1.0)
        found.append((fitted(alignment, start, samples.points.mean(axis=0), old, new, given.agreement,
                             patches.prefers(new, old)), moved))
        if found[-1][0].agreement > WELL:
            break
    if not found:
        return None, None
    fit, moved = max(found, key=lambda one: one[0].agreement)
    return fit, moved if fit.better else None


class _Trial:
    """One reading, measured. Detail readings use the pairs and patches of the cameras as given."""

    def __init__(self, way: Change, cams: list[Camera], keep: np.ndarray, greys: list[np.ndarray] | None,
                 samples: patches.Samples, given: "_Trial | None" = None):
        self.way, self.scores, self.samples = way, np.zeros(0), samples
        self.seen, self.pairs = np.zeros(0, bool), list[tuple[int, int]]()
        cameras = [way.of(camera) for camera in cams]
        self.front, self.inside = patches.shares(cameras, samples.points)
        if greys is None:
            return
        chosen = [cameras[k] for k in keep]
        self.seen, self.pairs = patches.overlaps(chosen, samples) if given is None else (given.seen, given.pairs)
        if self.pairs:
            self.scores = patches.patch_correlation(chosen, greys, self.pairs, self.seen, samples)

    def reading(self, given: "_Trial") -> Reading:
        compared = int(np.isfinite(self.scores).sum())
        agreement = float(np.nanmedian(self.scores)) if compared >= patches.LEAST else None
        better = False
        if self is not given and self.pairs is given.pairs and agreement is not None:
            # where poses are off, any shift may help a little
            enough = agreement > WELL or clearly_better(agreement, float(np.nanmedian(given.scores)))
            better = enough and patches.prefers(self.scores, given.scores)
        return Reading(self.way.name, float(self.front.mean()), float(self.inside.mean()),
                       int((self.inside > _SEES).sum()), agreement, compared, self.way.mend,
                       better)


def _best(readings: Sequence[Reading], count: int) -> Reading:
    """The reading to use: as given unless another one is clearly right."""
    given, poses = readings[0], readings[1:len(POSES)]
    level = given.agreement or 0.0
    turned = [r for r in readings for way in ROTATED if r.name == way.name]
    agreeing = [r for r in (*poses, *turned) if (r.agreement or 0.0) > max(max(level, 0.0) + _CLEAR, _CLEAR * 2)]
    if agreeing:
        return max(agreeing, key=lambda r: r.agreement or 0.0)
    for reading in readings:
        if reading.name == DETAILS[0].name and reading.better and (reading.agreement or 0.0) > level + 0.02:
            return reading
    if given.agreement is None and given.seeing == 0:
        return max((r for r in poses if 2 * r.seeing >= count), key=lambda r: (r.seeing, r.inside), default=given)
    return given
