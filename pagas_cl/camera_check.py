"""Are these the right cameras for this mesh and these photos? And if not, which reading of their numbers is?

Every reading that people mix up is tried: the matrices as given, inverted, with y and z flipped (OpenGL), the principal
point counted from the bottom, pixel centres half a pixel off. How much of the mesh each sees, and how well photos agree
over the mesh, decides; what the photos cannot decide is said to be undecided.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene import patches
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.inputs import as_cameras, as_views
from pagas_cl.scene.mesh import to_surface
from pagas_cl.scene.view import View

log = logging.getLogger("pagas_cl")

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_SEES = 0.002        # a view sees the mesh when this share of it is inside; fewer samples than that are chance
_LEAST_PATCHES = 30
_CLEAR = 0.15        # a pose reading must correlate better by this much
_GOOD = 0.5          # correlation of photos that agree


@dataclass(frozen=True)
class ViewCheck:
    """Shares (0 to 1) of the mesh's area in front of a view and inside its image."""

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

    def as_dict(self) -> dict:
        """Plain nested dictionary, ready for JSON."""
        return asdict(self)


def _posed(change):
    return lambda camera: replace(camera, world_to_camera=change(camera.world_to_camera))


def _shifted(step: float):
    return lambda camera: replace(camera, cx=camera.cx + step, cy=camera.cy + step)


# name, what it does to a camera, what mends it
_POSES = (
    ("as given", lambda camera: camera, ""),
    ("inverted", _posed(inverse_pose), "Camera.from_c2w(K, matrix, ...)"),
    ("y and z flipped", _posed(lambda m: _FLIP @ m),
     "Camera.from_opengl_c2w(K, camera_to_world, ...), with the camera-to-world matrices"),
    ("inverted, y and z flipped", _posed(lambda m: _FLIP @ inverse_pose(m)),
     "Camera.from_opengl_c2w(K, matrix, ...)"),
)
_DETAILS = (
    ("principal point from the bottom", lambda camera: replace(camera, cy=camera.height - camera.cy),
     "cy = height - cy (in MeshLab projects: flavour='openmvs' or 'meshlab')"),
    ("half a pixel more", _shifted(0.5), "pixel_center=0 in the constructor (K counts pixel centres at whole numbers)"),
    ("half a pixel less", _shifted(-0.5), "pixel_center=0.5 in the constructor (K counts pixel centres at +0.5)"),
)


def check_cameras(mesh, cams, images=None) -> CameraReport:
    """Check cameras against a mesh and, where given, photos.

    Parameters
    ----------
    mesh : anything that `refine_mesh` takes
    cams : list of Camera, Open3D PinholeCameraTrajectory, or pycolmap Reconstruction
    images : list of arrays or paths, dict by camera name, or a folder; optional
        Without photos only what each view sees of the mesh is compared.
    """
    if images is None:
        return check_views(mesh, as_cameras(cams), None)
    views = as_views(cams, images)
    return check_views(mesh, [view.camera for view in views], views)


def check_views(mesh, cams: list[Camera], views: list[View] | None, most: int = 10) -> CameraReport:
    """The same for a scene's views; at most `most` photos, evenly chosen, are decoded."""
    if not cams:
        raise InputError("no cameras were given, expected at least one")
    samples = patches.sample_surface(to_surface(mesh))
    if not samples.few:
        raise InputError("the mesh has no area: all its triangles are degenerate")
    keep = np.unique(np.linspace(0, len(cams) - 1, min(most, len(cams))).astype(int))
    greys = None if views is None else [patches.grey_of(views[k].load_image()) for k in keep]
    trials = [_Trial(entry, cams, keep, greys, samples) for entry in _POSES]
    given = trials[0]
    details = []
    if given.pairs:
        details = [_Trial(entry, cams, keep, greys, samples, given) for entry in _DETAILS]
    readings = tuple(trial.reading(given) for trial in trials + details)
    checks = tuple(ViewCheck(camera.name or f"view {i}", float(f), float(n))
                   for i, (camera, f, n) in enumerate(zip(cams, given.front, given.inside)))
    best = _best(readings)
    return CameraReport(best is readings[0] and best.seeing > 0, _sentence(readings, best, len(cams)),
                        _half_pixel(readings), best.name, readings, checks)


class _Trial:
    """One reading, measured. Detail readings use the pairs and patches of the cameras as given."""

    def __init__(self, entry, cams, keep, greys, samples, given=None):
        self.name, change, self.mend = entry
        cameras = [change(camera) for camera in cams]
        shares = np.array([[part.mean() for part in patches.inside(camera, samples.points)] for camera in cameras])
        self.front, self.inside = shares.T
        chosen = [cameras[k] for k in keep]
        self.scores, self.pairs, self.seen = None, [], None
        if greys is None:
            return
        if given is None:
            self.seen = np.array([patches.visible(camera, samples) for camera in chosen])
            self.pairs = patches.choose_pairs(chosen, self.seen, samples)
        else:
            self.seen, self.pairs = given.seen, given.pairs
        if self.pairs:
            self.scores = patches.patch_correlation(chosen, greys, self.pairs, self.seen, samples)

    def reading(self, given: _Trial) -> Reading:
        compared = 0 if self.scores is None else int(np.isfinite(self.scores).sum())
        agreement = float(np.nanmedian(self.scores)) if compared >= _LEAST_PATCHES else None
        paired = self is not given and self.pairs is given.pairs and agreement is not None
        better = paired and patches.prefers(self.scores, given.scores)[0]
        return Reading(self.name, float(self.front.mean()), float(self.inside.mean()),
                       int((self.inside > _SEES).sum()), agreement, compared, self.mend, better)


def _best(readings) -> Reading:
    """The reading to use: as given unless another one is clearly right."""
    given, poses = readings[0], readings[1:len(_POSES)]
    if any(reading.agreement is not None for reading in (given, *poses)):
        level = max(given.agreement or 0.0, 0.0)
        rivals = [r for r in poses if r.agreement is not None and r.agreement > max(level + _CLEAR, _CLEAR * 2)]
        if rivals:
            return max(rivals, key=lambda r: r.agreement)
        bottom = next((r for r in readings if r.name == _DETAILS[0][0]), None)
        if bottom is not None and bottom.better and bottom.agreement > (given.agreement or 0) + 0.02:
            return bottom
        if given.agreement is not None:
            return given
    if given.seeing == 0:
        rivals = [r for r in poses if r.seeing > 0]
        return max(rivals, key=lambda r: (r.seeing, r.inside), default=given)
    return given


def _sentence(readings, best: Reading, count: int) -> str:
    given = readings[0]
    behind = "; the mesh lies behind them" if given.front < 0.05 else ""
    sees = f"{given.seeing} of {count} cameras see the mesh{behind}"
    if best is not given:
        if best.seeing and not given.seeing:
            return f"{sees}; {best.name}, {best.seeing} of {count} do{_agree(best)}: use {best.mend}"
        return (f"photos agree better over the mesh with the cameras {best.name} ({_number(best)} instead of "
                f"{_number(given)}): use {best.mend}")
    if given.seeing == 0:
        return (f"{sees}, in no reading of their numbers: cameras and mesh are in different coordinate frames or units "
                "(align them first), or the mesh belongs to another scene")
    if given.agreement is None:
        return f"{sees}; too few textured patches are seen by two photos to say more"
    if given.agreement < _GOOD:
        return (f"{sees}, but the photos agree only {_number(given)} over it, and no other reading of the cameras does "
                "better: is the mesh coarse, are photos and cameras paired rightly, do the photos fit together?")
    return f"{sees}, and the photos agree over it ({_number(given)}): the cameras are right as they are"


def _agree(reading: Reading) -> str:
    return "" if reading.agreement is None else f", and the photos agree ({_number(reading)})"


def _number(reading: Reading) -> str:
    return "unknown" if reading.agreement is None else f"{reading.agreement:.2f}"


def _half_pixel(readings) -> str:
    found = [r for r in readings if r.name.startswith("half a pixel")]
    better = [r for r in found if r.better]
    given = readings[0]
    if not found or given.agreement is None:
        return "pixel centres: not compared, since no two photos could be"
    agreements = ", ".join(f"{r.name} {r.agreement:.4f}" for r in found if r.agreement is not None)
    if better:
        best = max(better, key=lambda r: r.agreement)
        return (f"pixel centres: the photos prefer {best.name} (as given {given.agreement:.4f}, {agreements}); if K "
                f"came from a program that counts so, use {best.mend}")
    return (f"pixel centres: the photos do not ask for a shift (as given {given.agreement:.4f}, {agreements}); a shift "
            "that all views share hardly shows unless cameras are rolled against each other")
