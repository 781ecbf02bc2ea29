"""Cameras turned and moved at random, and how far cameras are from the true ones, in pixels of their photos."""

from __future__ import annotations

import numpy as np

from pagas_cl.method.cameras.motion import moved, pixel_motion, placed


def noisy(cameras, pixels: float, seed: int, distance: float = 650.0) -> list:
    """Each camera turned and moved at random, its photo by `pixels` in all (root mean square, about); `distance`: of
    what it looks at."""
    rng, out = np.random.default_rng(seed), []
    for camera in cameras:
        each = pixels / 1.83 / camera.fx        # four of the six numbers move the photo, roll and advance a little
        out.append(moved(camera, np.concatenate([each * rng.normal(size=3), each * distance * rng.normal(size=3)])))
    return out


def rms_motion(cameras, others, depths) -> float:
    """Pixels by which the points of the depth maps move in the photos from one list of cameras to the other."""
    squares = []
    for camera, other, depth in zip(cameras, others, depths):
        points = (camera.rays() * depth[..., None])[4::8, 4::8][depth[4::8, 4::8] > 0]
        squares.append(pixel_motion(camera, other, points @ camera.world_to_camera[:3, :3] + camera.center) ** 2)
    return float(np.sqrt(np.mean(squares)))


def unexplained(true, cameras, depths, used) -> float:
    """Pixels that true matches are off by through `cameras`, each point at the depth that suits its context views
    (`used`, of each view) best: what photos can see of cameras that are off. `depths`: true ones."""
    rng, squares = np.random.default_rng(0), []
    for t, others in enumerate(used):
        rows, columns = (rng.permutation(np.argwhere(depths[t] > 0))[:300]).T
        d = depths[t][rows, columns].astype(np.float64)
        points = (true[t].rays_at(rows, columns) * d[:, None]) @ true[t].world_to_camera[:3, :3] + true[t].center
        there = [true[k].project(points)[0] for k in others]
        rays = cameras[t].rays_at(rows, columns) @ cameras[t].world_to_camera[:3, :3]

        def at(d):
            return np.array([cameras[k].project(rays * d[:, None] + cameras[t].center)[0] for k in others]) - there

        for _ in range(8 if others else 0):
            slope = (at(1.0001 * d) - at(d)) / (1e-4 * d)[:, None]
            d = d - np.clip((slope * at(d)).sum((0, 2)) / (slope**2).sum((0, 2)), -0.2 * d, 0.2 * d)
        squares += [(at(d) ** 2).sum(-1).mean()] if others else []
    return float(np.sqrt(np.mean(squares)))


def after_similarity(cameras, true) -> list:
    """`cameras` after the similarity that brings their centres and axes nearest to those of `true`."""
    there, here = (np.array([c.center for c in those]) for those in (true, cameras))
    reach = 2 * np.linalg.norm(there - there.mean(0), axis=1).mean()
    there, here = (np.concatenate([centers, centers + reach * np.array([c.direction for c in those])])
                   for centers, those in ((there, true), (here, cameras)))
    a, b = here.mean(0), there.mean(0)
    u, sizes, vt = np.linalg.svd((there - b).T @ (here - a))
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn, scale = u * sign @ vt, (sizes * sign).sum() / ((here - a) ** 2).sum()
    return [placed(c, c.world_to_camera[:3, :3] @ turn.T, b + scale * turn @ (c.center - a)) for c in cameras]
