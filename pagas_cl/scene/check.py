"""Are these the right cameras for this mesh and these photos? And if not, which reading of their numbers is?

Every reading that people mix up is tried. How much of the mesh each sees, and how well photos agree over the mesh,
decides; what the photos cannot decide is said to be undecided. `check_seen` is the part of it that needs no photos and
goes before every refinement.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene import patches
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.inputs import Cameras, Images, as_cameras, as_views
from pagas_cl.scene.mesh import Mesh, Surface, to_surface
from pagas_cl.scene.view import View

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_SAMPLES = 20_000
_WORK = 20_000_000   # camera-point pairs of one reading of the poses
_CHANCE = 0.0005     # share of the mesh that a wrong reading may have in an image by chance; a city's view has more
_SEES = 0.002        # the same of the fewer samples that photos are compared at
_CLEAR = 0.15        # a pose reading must correlate better by this much
_GOOD = 0.5          # correlation of photos that agree


class _Change(NamedTuple):
    """A way to read the cameras' numbers: what it does to a camera, what mends it, and the matrices in words."""

    name: str
    of: Callable[[Camera], Camera]
    mend: str
    matrices: str = ""


def _posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Camera], Camera]:
    return lambda camera: replace(camera, world_to_camera=change(camera.world_to_camera))


def _shifted(step: float) -> Callable[[Camera], Camera]:
    return lambda camera: replace(camera, cx=camera.cx + step, cy=camera.cy + step)


POSES = (
    _Change("as given", lambda camera: camera, ""),
    _Change("inverted", _posed(inverse_pose), "Camera.from_c2w(K, matrix, ...)", "the inverse matrices"),
    _Change("y and z flipped", _posed(lambda m: _FLIP @ m),
            "Camera.from_opengl_c2w(K, camera_to_world, ...), with the camera-to-world matrices",
            "y and z flipped (OpenGL axes)"),
    _Change("inverted, y and z flipped", _posed(lambda m: _FLIP @ inverse_pose(m)),
            "Camera.from_opengl_c2w(K, matrix, ...)", "the inverse matrices and y and z flipped (OpenGL axes)"),
)
_DETAILS = (
    _Change("principal point from the bottom", lambda camera: replace(camera, cy=camera.height - camera.cy),
            "cy = height - cy (in MeshLab projects: flavour='openmvs' or 'meshlab')"),
    _Change("half a pixel more", _shifted(0.5),
            "pixel_center=0 in the constructor (K counts pixel centres at whole numbers)"),
    _Change("half a pixel less", _shifted(-0.5),
            "pixel_center=0.5 in the constructor (K counts pixel centres at +0.5)"),
)


def check_seen(surface: Surface | np.ndarray, cameras: list[Camera]) -> npt.NDArray[np.float64]:
    """Raise InputError when the poses are such that hardly a camera sees the mesh, saying which reading would mend it.

    `surface` is the mesh, or its vertices (V, 3) in world coordinates. Returns the share of its points in front of and
    inside each camera's image, float64 (cameras,).
    """
    if not cameras:
        raise InputError("there are no cameras: nothing can be refined")
    points = sample_points(surface, min(_SAMPLES, max(500, _WORK // len(cameras))))
    front, inside = patches.shares(cameras, points)
    seeing, count = int(np.count_nonzero(inside)), len(cameras)
    if 2 * seeing >= count:
        return inside
    better = [int(np.count_nonzero(patches.shares([way.of(camera) for camera in cameras], points)[1] > _CHANCE))
              for way in POSES[1:]]
    best = int(np.argmax(better))  # the first of equals: the simplest reading
    behind = int(np.count_nonzero(front < 0.5))
    who = f"{seeing} of {count} cameras see the mesh" + (f", it lies behind {behind} of {count}" if behind else "")
    if better[best] >= (0.9 * count if seeing else max(1, 0.5 * count)):
        way = POSES[1 + best]
        raise InputError(f"{who}; with {way.matrices} {better[best]} of {count} do: pass "
                         f"{way.mend.partition('(')[0]}(...)")
    if seeing == 0:
        centers = np.array([camera.center for camera in cameras])
        raise InputError(f"{who}, nor do more with inverse matrices or OpenGL axes: the mesh spans {_box(points)}, the "
                         f"cameras are at {_box(centers)}; are mesh and cameras in the same frame and unit?")
    return inside


def sample_points(surface: Surface | np.ndarray, count: int) -> npt.NDArray[np.float64]:
    """Up to `count` vertices, evenly taken, and as many points on the faces, by area: float64 (N, 3)."""
    vertices = surface.vertices if isinstance(surface, Surface) else np.asarray(surface, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise InputError(f"vertices have shape {vertices.shape}, expected (V, 3) with at least one")
    points = vertices[patches.evenly(len(vertices), count)]
    if not isinstance(surface, Surface):
        return points
    step = np.arange(count)
    u, v = (0.5 + step * 0.7548776662466927) % 1, (0.5 + step * 0.5698402909980532) % 1  # plastic-number sequence
    return np.concatenate([points, patches.on_faces(surface, (step + 0.5) / count, u, v)[0]])


def _box(places: np.ndarray) -> str:
    return " to ".join(f"({', '.join(f'{v:.4g}' for v in end)})" for end in (places.min(axis=0), places.max(axis=0)))


@dataclass(frozen=True)
class ViewCheck:
    """Shares of the mesh's area in front of a view and inside its image."""

    name: str
    front: float
    inside: float


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
class CameraReport:
    """What `check_cameras` found.

    `ok`: the cameras as given see the mesh and are the best reading; `sentence`: what is wrong and what mends it, or
    that nothing is; `half_pixel`: what the photos say about pixel centres; `readings`: as given first.
    """

    ok: bool
    sentence: str
    half_pixel: str
    best: str
    readings: tuple[Reading, ...]
    views: tuple[ViewCheck, ...]

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


def check_views(mesh: Mesh, cams: list[Camera], views: list[View] | None, most: int = 10) -> CameraReport:
    """The same for a scene's views; at most `most` photos, evenly chosen, are decoded."""
    if not cams:
        raise InputError("no cameras were given, expected at least one")
    samples = patches.sample_surface(to_surface(mesh))
    if not samples.few:
        raise InputError("the mesh has no area: all its triangles are degenerate")
    keep = patches.evenly(len(cams), most)
    greys = None if views is None else [patches.grey_of(views[k].load_image()) for k in keep]
    given = _Trial(POSES[0], cams, keep, greys, samples)
    trials = [given, *(_Trial(way, cams, keep, greys, samples) for way in POSES[1:])]
    if given.pairs:
        trials += [_Trial(way, cams, keep, greys, samples, given) for way in _DETAILS]
    readings = [trial.reading(given) for trial in trials]
    checks = tuple(ViewCheck(camera.name or f"view {i}", float(f), float(n))
                   for i, (camera, f, n) in enumerate(zip(cams, given.front, given.inside)))
    best = _best(readings)
    return CameraReport(best is readings[0] and best.seeing > 0, _sentence(readings[0], best, len(cams)),
                        _half_pixel(readings), best.name, tuple(readings), checks)


class _Trial:
    """One reading, measured. Detail readings use the pairs and patches of the cameras as given."""

    def __init__(self, way: _Change, cams: list[Camera], keep: np.ndarray, greys: list[np.ndarray] | None,
                 samples: patches.Samples, given: "_Trial | None" = None):
        self.way, self.scores = way, np.zeros(0)
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
        paired = self is not given and self.pairs is given.pairs and agreement is not None
        return Reading(self.way.name, float(self.front.mean()), float(self.inside.mean()),
                       int((self.inside > _SEES).sum()), agreement, compared, self.way.mend,
                       paired and patches.prefers(self.scores, given.scores))


def _best(readings: Sequence[Reading]) -> Reading:
    """The reading to use: as given unless another one is clearly right."""
    given, poses = readings[0], readings[1:len(POSES)]
    level = given.agreement or 0.0
    agreeing = [r for r in poses if (r.agreement or 0.0) > max(max(level, 0.0) + _CLEAR, _CLEAR * 2)]
    if agreeing:
        return max(agreeing, key=lambda r: r.agreement or 0.0)
    for reading in readings:
        if reading.name == _DETAILS[0].name and reading.better and (reading.agreement or 0.0) > level + 0.02:
            return reading
    if given.agreement is None and given.seeing == 0:
        return max((r for r in poses if r.seeing > 0), key=lambda r: (r.seeing, r.inside), default=given)
    return given


def _sentence(given: Reading, best: Reading, count: int) -> str:
    behind = "; the mesh lies behind them" if given.front < 0.05 else ""
    sees = f"{given.seeing} of {count} cameras see the mesh{behind}"
    if best is not given and best.seeing and not given.seeing:
        agree = "" if best.agreement is None else f", and the photos agree ({best})"
        return f"{sees}; {best.name}, {best.seeing} of {count} do{agree}: use {best.mend}"
    if best is not given:
        return (f"photos agree better over the mesh with the cameras {best.name} ({best} instead of {given}): use "
                f"{best.mend}")
    if given.seeing == 0:
        return (f"{sees}, in no reading of their numbers: cameras and mesh are in different coordinate frames or units "
                "(align them first), or the mesh belongs to another scene")
    if given.agreement is None:
        return f"{sees}; too few textured patches are seen by two photos to say more"
    if given.agreement < _GOOD:
        return (f"{sees}, but the photos agree only {given} over it, and no other reading of the cameras does better: "
                "is the mesh coarse, are photos and cameras paired rightly, do the photos fit together?")
    return f"{sees}, and the photos agree over it ({given}): the cameras are right as they are"


def _half_pixel(readings: Sequence[Reading]) -> str:
    found = [r for r in readings if r.name.startswith("half a pixel") and r.agreement is not None]
    given = readings[0].agreement
    if not found or given is None:
        return "pixel centres: not compared, since no two photos could be"
    agreements = ", ".join([f"as given {given:.4f}", *(f"{r.name} {r.agreement:.4f}" for r in found)])
    better = [r for r in found if r.better]
    if better:
        best = max(better, key=lambda r: r.agreement or 0.0)
        return (f"pixel centres: the photos prefer {best.name} ({agreements}); if K came from a program that counts "
                f"so, use {best.mend}")
    return (f"pixel centres: the photos do not ask for a shift ({agreements}); a shift that all views share hardly "
            "shows unless cameras are rolled against each other")
