"""Small synthetic scenes on which photos speak for no depth, or for a wrong one; the truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from support.random_scenes import rotation
from support.scenes import relief_scene

from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.scene.camera import Camera

SIZE = dict(width=120, height=90)


def textureless(noise: float = 2.0):
    """A plane without texture; the initial depth is off by a smooth error."""
    made = relief_scene(**SIZE, contexts=4, held_out=0, base=0.0, detail=0.0, steps=0, texture="flat", contrast=0.0,
                        shading=0.0, noise=noise, coarse_error=0.5)
    return made, list(made.views)


def wrong_poses(pixels: float = 3.0, contexts: int = 4, seed: int = 3, **settings):
    """Every camera but the target's is turned so that its photo is off by `pixels`, each in another direction."""
    made = relief_scene(**SIZE, contexts=contexts, held_out=0, **settings)
    rng = np.random.default_rng(seed)
    return made, [made.views[0], *(replace(v, camera=turned(v.camera, pixels, rng.uniform(0, 2 * np.pi)))
                                   for v in made.views[1:])]


def turned(camera: Camera, pixels: float, direction: float) -> Camera:
    """The camera turned by as much as moves its photo by `pixels`."""
    x, y = pixels / camera.fx * np.cos(direction), pixels / camera.fy * np.sin(direction)
    turn = np.eye(4)
    turn[:3, :3] = rotation(np.array([-y, x, 0.0]))
    return Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                  turn @ camera.world_to_camera, camera.name)


def moving(share: float = 0.45, **settings):
    """Content of each context photo that is another one in a part of it."""
    made = relief_scene(**SIZE, contexts=4, held_out=0, **settings)
    views = [made.views[0]]
    for k, view in enumerate(made.views[1:]):
        image = view.load_image().copy()
        height, width = image.shape[:2]
        other = _other_photo(k)
        rows = slice(int(height * 0.25), int(height * (0.25 + share)))
        columns = slice(int(width * 0.25), int(width * (0.25 + share)))
        image[rows, columns] = other[rows, columns]
        views.append(replace(view, image=image))
    return made, views


@lru_cache
def _other_photo(k: int):
    return relief_scene(**SIZE, contexts=1, held_out=0, seed=50 + k).image(0)


def figures(made, depth) -> dict[str, float]:
    """Mean and median depth error in pixels of parallax, mean and median angle of the normals in degrees; means
    also of the pixels beside discontinuities, where there are any."""
    report = compare_depth(depth, made.true_depth(made.cameras[0]), made.cameras[0], parallax=made.relief.parallax,
                           true_normals=made.true_normals(made.cameras[0]))
    return {f"{name}{where}": value for where, part in (("", report.all), (" near edges", report.edges))
            for name, value in (("mean", part.mean_parallax), ("median", part.median_parallax),
                                ("normal mean", part.normal_mean), ("normal median", part.normal_median))
            if value == value and not (where and "median" in name)}
