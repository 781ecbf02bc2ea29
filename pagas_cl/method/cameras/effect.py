"""The effect `cameras` (method section 8): whether cameras are refined before the views are, for a whole scene."""

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

from pagas_cl.config import Config
from pagas_cl.errors import DeviceError, log
from pagas_cl.method.cameras.adjust import MakeBlocks, blocks
from pagas_cl.method.cameras.frames import depths_of
from pagas_cl.method.cameras.refine import OFF, CameraRefinement, photos_off, refine_cameras
from pagas_cl.method.effects.decide import Decision
from pagas_cl.method.splat import PhotoStore
from pagas_cl.progress import NONE, Progress, stage
from pagas_cl.runtime.device import one_of, open_device
from pagas_cl.scene.inputs import Depth
from pagas_cl.scene.mesh import Mesh
from pagas_cl.scene.view import View

FEWEST = 4                # views: three to measure how far a camera is off, and one more to judge
MOST = 300                # views for which it is decided unasked: all depth maps are in memory at once


def resolve_cameras(views: Sequence[View], depths_or_mesh: Sequence[Depth | None] | Mesh, config: Config,
                    device: Any = None, progress: Progress = NONE, photos: PhotoStore | None = None,
                    open_blocks: Callable[[], AbstractContextManager[MakeBlocks]] = lambda: nullcontext(blocks),
                    ) -> tuple[list[View], Config, CameraRefinement | None]:
    """Decide effects.cameras: the views with the cameras that follow, settings in which it is "set", and the refinement
    (None where the scene does not need it). Arguments as in refine_cameras; `photos`, on the one device, serve whoever
    works on the views after it; `open_blocks()` is a context of its `make_blocks`."""
    resolved = replace(config, effects=replace(config.effects, cameras="set"))
    choice = config.effects.cameras
    if not _may(choice, len(views)):
        if choice == "auto" and len(views) > MOST:
            log.info("cameras: taken as they are, not checked (of more than %d views that is done only where "
                     "effects.cameras is 'on')", MOST)
        return list(views), resolved, None
    try:
        here, off = open_device(one_of(device)), None
    except DeviceError as error:
        if choice == "on":
            raise
        log.warning("cameras stay unchanged and are not checked, since that takes an OpenCL device: %s", error)
        return list(views), resolved, None
    if choice == "auto":
        with stage(progress, "measure the cameras", 1) as measuring:
            decision, off = decide_cameras(views, depths_or_mesh, config, here, photos)
            measuring.advance(1)
        log.debug("%s", decision)
        if not decision.on:
            log.info("cameras: no error was found, they stay unchanged")
            return list(views), resolved, None
    with open_blocks() as make_blocks:
        found = refine_cameras(views, depths_or_mesh, config=config, device=here, progress=progress, measured=off,
                               photos=photos, make_blocks=make_blocks)
    far = not found.accepted and found.report.get("coarse")        # many photos are off by pixels, and stay so
    log.log(logging.WARNING if far else logging.INFO, "%s", found)
    moved = [view if camera is view.camera else replace(view, camera=camera)
             for view, camera in zip(views, found.cameras)]
    if photos is not None:
        photos.replace(views, moved)
    return moved, resolved, found


def decide_cameras(views: Sequence[View], depths_or_mesh, config: Config, device,
                   photos: PhotoStore | None = None) -> tuple[Decision, tuple[float, float]]:
    """Whether a scene needs it, and what photos_off measured."""
    device = open_device(device)
    depths = depths_of(depths_or_mesh, device)[0]([view.camera for view in views])
    off = photos_off(views, depths, config, device, photos or PhotoStore(device))
    return Decision.of("cameras", config, off[0], OFF, off[0] > OFF, "epipolar residual, pixels"), off


def camera_seconds(views: Sequence[View], depths_or_mesh, config: Config, device, number: int) -> float:
    """Seconds a view that effects.cameras takes in a scene of `number` views, by those of `views`, a few neighbours."""
    if not _may(config.effects.cameras, number) or len(views) < FEWEST:
        return 0.0
    decision, off = decide_cameras(views, depths_or_mesh, config, device)
    if not decision.on:
        return 0.0
    found = refine_cameras(views, depths_or_mesh, config=config, device=device, measured=off)
    return found.report.get("seconds", 0.0) / len(views)


def _may(choice: str, number: int) -> bool:
    return choice == "on" or (choice == "auto" and FEWEST <= number <= MOST)
