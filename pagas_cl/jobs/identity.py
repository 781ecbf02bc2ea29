"""What makes two tasks the same: a hash of their inputs, their settings and the code that does them."""

from __future__ import annotations

import hashlib
import json
import pickle
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from pagas_cl.config import Config
from pagas_cl.jobs.store import digest_file
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.partners import Partners
from pagas_cl.scene.view import View

# What a refined depth map depends on. Choosing partners is left out: they are named in the key.
_CODE = ("scene", "runtime", "splat", "cl_kernels", "refine.py", "config.py", "effects.py", "measurements.py",
         "acceptance.py", "result.py")
_OTHER_SETTINGS = ("context", "fusion")


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of the source that makes a depth map: Python and kernels."""
    digest = hashlib.blake2b(digest_size=16)
    for part in _CODE:
        home = files(f"pagas_cl.{part}") if "." not in part else files("pagas_cl")
        names = (part,) if "." in part else sorted(item.name for item in home.iterdir()
                                                   if item.name.endswith((".py", ".cl", ".clh")))
        for name in names:
            digest.update(f"{part}/{name}\n".encode() + home.joinpath(name).read_bytes())
    return digest.hexdigest()


def view_digest(view: View) -> str:
    """Hash of a view whose photo and mask are on disk: their content, the camera, the name."""
    parts = [view.name, *_numbers(view.camera), *(_source_digest(source) for source in (view.image, view.mask))]
    return hashlib.blake2b(json.dumps(parts).encode(), digest_size=16).hexdigest()


def task_key(partners: Partners, digests: dict[int, str], depth_digest: str, config: Config, work) -> str:
    """Hash of one view's task; `digests` by place, `work` the function that does it."""
    settings = config.as_dict()
    parts = [code_version(), f"{work.__module__}.{work.__qualname__}", depth_digest,
            [digests[index] for index in partners.all], len(partners.contexts), partners.reason,
            {name: value for name, value in settings.items() if name not in _OTHER_SETTINGS}]
    return hashlib.blake2b(json.dumps(parts).encode(), digest_size=16).hexdigest()


def _numbers(camera: Camera) -> list:
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_to_camera.ravel().tolist()]
    return [camera.width, camera.height, *(float(number).hex() for number in numbers)]


def _source_digest(source) -> str:
    if source is None or hasattr(source, "digest"):
        return getattr(source, "digest", "")
    if isinstance(source, Path):
        return digest_file(source)
    described = hashlib.blake2b(pickle.dumps(source, protocol=4), digest_size=16).hexdigest()  # a lens, and a path
    return digest_file(source.path) + described
