"""Scenes of other programs. One small module a format, each with `detect(folder) -> bool` and `read(folder) -> Scene`.

A new format is a new file here and its name in FORMATS.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pagas_cl.errors import InputError
from pagas_cl.scene.links import tell_links
from pagas_cl.scene.view import Scene

# In the order of looking: what names its convention and its photos itself comes first.
FORMATS = {
    "cameras": "camera_file",
    "colmap": "colmap",
    "nerfstudio": "nerfstudio",
    "mvsnet": "mvsnet",
    "neus": "neus",
    "open3d": "open3d_trajectory",
    "bundler": "bundler",
    "meshlab": "meshlab",
}


def formats() -> list[str]:
    """Names of the formats that this installation reads."""
    return [name for name, module in FORMATS.items() if find_spec(f"{__name__}.{module}") is not None]


def read_scene(folder: str | Path, format: str | None = None, **options: Any) -> Scene:
    """Read the scene in `folder`.

    Parameters
    ----------
    folder : path
    format : str, optional
        One of `formats()`; found by looking at the folder where it is left out.
    options
        Passed on to the format's `read`.

    Raises
    ------
    InputError
        The folder does not exist, holds no known format, or its content cannot be used.
    """
    folder = Path(folder)
    if not folder.exists():
        raise InputError(f"scene {str(folder)!r} does not exist")
    known = formats()
    if format is not None and format not in known:
        raise InputError(f"unknown format {format!r}, expected one of {', '.join(known)}")
    for name in known if format is None else [format]:
        module = import_module(f"{__name__}.{FORMATS[name]}")
        if format is not None or module.detect(folder):
            scene: Scene = module.read(folder, **options)
            tell_links(scene.views, folder)
            return scene
    raise InputError(f"scene {str(folder)!r} holds no cameras in a known format ({', '.join(known)}); expected for "
                     "instance images/ and a COLMAP model in sparse/0")
