"""Hard cases of cameras that are off: brought back, or left as they are with the reason; the same bits twice."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from support.hard_check import Outcome
from support.scenes import relief_scene
from support.synthetic.layout import camera_at

from pagas_cl.method.cameras.motion import moved, placed
from pagas_cl.method.cameras.refine import refine_cameras
from pagas_cl.scene.view import View

_DISTANCE = 650.0         # of the cameras from the relief


@dataclass(frozen=True)
class CameraCase:
    """As hard_table.Case: settings of a relief, what is done to its views (cameras off already) and to its cameras
    before; which views' cameras are wrong; `still`: none may move. `tolerance`: most that may be left of the cost of
    pairs that judge."""

    name: str
    settings: dict
    change: Callable[[list[View]], Sequence[View]] = list
    line: bool = False
    wrong: tuple[str, ...] = ()
    still: bool = False
    tolerance: float = 0.4
    blends: tuple[str, ...] = ("cameras",)


def _patch(views):
    """Something before the surface that moves from photo to photo."""
    patch = np.random.default_rng(1).integers(0, 255, (8, 10, 3), np.uint8).repeat(3, 0).repeat(3, 1)
    out = []
    for k, view in enumerate(views):
        photo = view.load_image().copy()
        photo[24:48, 20 + 5 * k:50 + 5 * k] = patch
        out.append(replace(view, image=photo))
    return out


def _one_wrong(views):
    camera = views[2].camera
    return [*views[:2], replace(views[2], camera=moved(camera, np.array([0, 30 / camera.fx, 0, 0, 0, 0]))), *views[3:]]


def _turned(views):
    """Cameras of one place."""
    first = views[0].camera
    return [replace(view, camera=placed(view.camera, first.world_to_camera[:3, :3], first.center)) for view in views]


def _repeated(views):
    """The same ten columns over and over, which hardly move: any of them could be the right ones."""
    return [replace(view, image=np.tile(view.load_image()[:, 40:50], (1, 10, 1))[:, :96]) for view in views]


CASES = [
    CameraCase("cameras off by a pixel", {}),
    CameraCase("cameras off: all on a line", {}, line=True),
    CameraCase("cameras off: a plane", dict(base=0.0, detail=0.0, steps=0)),
    CameraCase("cameras off: masks, exposure, noise", dict(exposure=0.3, foreground=True, noise=3.0), tolerance=0.6),
    CameraCase("cameras off: mixed focal lengths and sizes", dict(zooms=(1.0, 1.4, 0.8), sizes=(1.0, 1.3))),
    CameraCase("cameras off: something moves in the middle", {}, _patch, tolerance=0.8),
    CameraCase("one camera wrong by 30 px", {}, _one_wrong, wrong=("context_01",)),
    CameraCase("cameras off: two views", {}, lambda views: views[:2], still=True),
    CameraCase("cameras off: pure rotation", {}, _turned, still=True),
    CameraCase("cameras off: no texture", dict(texture="flat", shading=0.0), still=True),
    CameraCase("cameras off: repeated texture", {}, _repeated, still=True),
]


def run_camera_case(case: CameraCase, device) -> Outcome:
    """Run one case on an open device."""
    made = relief_scene(96, 72, 6, **{"held_out": 0, "texture": "noise", **case.settings})
    if case.line:
        made = replace(made, cameras=[camera_at(made.relief, str(k), k - 3, 0) for k in range(7)], _shared={})
    rng = np.random.default_rng(0)
    views = list(case.change([replace(view, camera=moved(
        view.camera, rng.normal(size=6) * np.repeat([1.0, _DISTANCE], 3) / (1.83 * view.camera.fx)))
        for view in made.all_views]))
    depths = [made.initial_depth(camera) for camera in made.cameras[:len(views)]]
    found, again = (refine_cameras(views, depths, device=device) for _ in range(2))
    faults = {"a second run gives other bits": any(
        a.world_to_camera.tobytes() != b.world_to_camera.tobytes() for a, b in zip(found.cameras, again.cameras)),
        f"accepted: {found.accepted}, expected {not case.still}": found.accepted is case.still,
        f"wrong are {found.left_out}, expected {case.wrong}": found.left_out != case.wrong,
        "no reason is given": found.accepted is bool(found.reason)}
    report = found.report
    worst = 0.0 if case.still else float((report.get("cost_after") or 1.0) / (report.get("cost_before") or 1.0))
    faults[f"{worst:.2g} of the cost is left"] = worst > case.tolerance
    return Outcome(case, *case.blends, worst, tuple(fault for fault, so in faults.items() if so))


def run_cameras(device) -> Iterator[Outcome]:
    """Every case, as they come."""
    return (run_camera_case(case, device) for case in CASES)
