"""Small analytic scenes for the tests, each made once a session."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import cycle

from support import synthetic

from pagas_cl.scene.camera import Camera

ALIKE = (1.0,)


def relief_scene(width: int = 388, height: int = 290, contexts: int = 10, **settings):
    """As synthetic.relief_scene, but the same scene whenever it is made again, with the photos that it has rendered by
    then: read-only. Further settings: those of mixed_scene."""
    return _made(width, height, contexts, **settings)


def mixed_scene(width: int, height: int, contexts: int, *, sizes: tuple[float, ...] = ALIKE,
                zooms: tuple[float, ...] = ALIKE, distances: tuple[float, ...] = ALIKE, **settings):
    """A new scene of synthetic.relief_scene, with context views whose images, focal lengths and distances are so many
    times the target's, in turn."""
    made = synthetic.relief_scene(width, height, contexts, **settings)
    if sizes == zooms == distances == ALIKE:
        return made
    target, *others = made.cameras
    changed = [_changed(camera, *by) for camera, *by in zip(others[:contexts], cycle(sizes), cycle(zooms),
                                                             cycle(distances))]
    return replace(made, cameras=[target, *changed, *others[contexts:]])


def _changed(camera: Camera, size: float, zoom: float, distance: float) -> Camera:
    """A camera with another size of image, focal length and distance from the origin, at which it looks."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= distance
    zoomed = replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom, world_to_camera=pose)
    return zoomed.resized(round(camera.width * size), round(camera.height * size))


_made = cache(mixed_scene)


def tiny(**settings):
    """96 x 72 pixels, 3 context views, 1 held out; `settings` as in synthetic.Relief."""
    return relief_scene(**{"width": 96, "height": 72, "contexts": 3, "held_out": 1, **settings})


def small(**settings):
    """388 x 290 pixels, 5 context views, 1 held out: big enough for error figures to mean something."""
    return relief_scene(**{"width": 388, "height": 290, "contexts": 5, "held_out": 1, **settings})


def plane(**settings):
    """A tiny scene whose surface is the plane z = 0."""
    return tiny(base=0.0, detail=0.0, steps=0, **settings)
