"""Small rigs of cameras with everything that a format may drop: off-centre, non-square, far from the origin."""

from dataclasses import replace

import numpy as np
from PIL import Image

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.view import View

UTM = np.array([450123.4567, 4649876.5432, 123.789])


def rotation(rng) -> np.ndarray:
    """A random rotation matrix."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_cameras(count=4, *, seed=0, offset=(0, 0, 0), size=(64, 48), centred=False, square=False, same=False):
    """Cameras with random poses around `offset`."""
    rng = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        w, h = size
        f = rng.uniform(0.8, 2) * w
        fy = f if square else f * rng.uniform(0.9, 1.1)
        c = (w / 2, h / 2) if centred else (w * rng.uniform(0.35, 0.65), h * rng.uniform(0.35, 0.65))
        if same and cameras:
            f, fy, c = cameras[0].fx, cameras[0].fy, (cameras[0].cx, cameras[0].cy)
        R = rotation(rng)
        center = np.asarray(offset) + rng.normal(size=3) * 5
        pose = np.column_stack([R, -R @ center])
        cameras.append(Camera(w, h, f, fy, *c, pose))
    return cameras


def with_photos(folder, cameras, place="images") -> list[View]:
    """Views whose photos (numbers as names) are written to `folder`/`place`."""
    (folder / place).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    views = []
    for number, camera in enumerate(cameras):
        path = folder / place / f"{number:08d}.png"
        Image.fromarray(rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8)).save(path)
        views.append(View(replace(camera, name=path.name), path, None, path.name))
    return views


def worst_difference(a: Camera, b: Camera) -> float:
    """Largest difference of two cameras, each number relative to its size where that is above 1.

    Translations are compared as centres: t mixes rotation errors with the distance to the origin.
    """
    assert (a.width, a.height) == (b.width, b.height)
    pairs = [(getattr(a, k), getattr(b, k)) for k in ("fx", "fy", "cx", "cy")]
    pairs += list(zip(a.world_to_camera[:3, :3].ravel(), b.world_to_camera[:3, :3].ravel()))
    far = max(1, np.abs(a.center).max())
    pairs += [(p / far, q / far) for p, q in zip(a.center, b.center)]
    return max(abs(p - q) / max(1, abs(p)) for p, q in pairs)
