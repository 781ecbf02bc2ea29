"""cameras.json: pagas_cl's own small camera file, so that the core runs without pycolmap.

    {"convention": "opencv world_to_camera, pixel centres at +0.5",
     "views": [{"image": "a.png", "width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240,
                "world_to_camera": [[4 numbers], x 4], "mask": "a.png"}]}

Image paths are relative to SCENE/images, those of masks ("mask" may be left out) to SCENE/masks.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import Camera, intrinsics
from pagas_cl.scene.own_files import write_json
from pagas_cl.scene.readers.photos import named, view_of
from pagas_cl.scene.view import Scene, View

NAME = "cameras.json"
EXPECTED = f"{NAME} with world_to_camera of its views"
CONVENTION = "opencv world_to_camera, pixel centres at +0.5"
_KNOWN = ("image", "mask", "width", "height", "fx", "fy", "cx", "cy", "world_to_camera", "name")


def detect(folder: Path) -> Path | None:
    path = folder / NAME
    text = untrusted.read_text(path) if path.is_file() else ""
    return path if CONVENTION in text or '"world_to_camera"' in text else None


def read(folder: Path, path: Path, *, outside: bool = False) -> Scene:
    views = []
    for entry, where in _entries(path):
        camera, mask = _camera(entry, where), entry.get("mask")
        image = named(folder / "images", entry["image"], f"{where}: image", outside)
        if mask is not None:
            mask = named(folder / "masks", mask, f"{where}: mask", outside)
        views.append(view_of(folder, camera, image, mask, entry["image"]))
    return Scene(views, str(path))


def _entries(path: Path) -> list[tuple[dict[str, Any], str]]:
    """The views of a file, and what to call each; InputError where its convention is another."""
    data = untrusted.read_json(path)
    if data.get("convention") != CONVENTION:
        raise InputError(f"{path}: convention is {short(data.get('convention'))}, expected {CONVENTION!r}; "
                         "convert the cameras and say so")
    return untrusted.objects(data, "views", "view", path, _KNOWN)


def entries_in(folder: Path) -> list[dict[str, Any]]:
    """The views of a cameras.json that `write` has left in the folder; none where there is none, or it is another."""
    if not (folder / NAME).is_file():
        return []
    try:
        entries = _entries(folder / NAME)
        for view, where in entries:
            _camera(view, where)
    except InputError as error:
        log.warning("%s is replaced, cameras of other depth maps with it: %s", folder / NAME, error)
        return []
    return [view for view, _ in entries]


def write(folder: Path, views: list[View], others: Sequence[dict[str, Any]] = ()) -> Path:
    """Write SCENE/cameras.json for views whose photos lie in SCENE/images; `others`: more, as of entries_in."""
    path, entries = folder / NAME, [*others]
    for view in views:
        camera = view.camera
        entry = {"image": view.name, **{k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")},
                 "world_to_camera": camera.world_to_camera.tolist()}
        if isinstance(view.mask, Path):
            entry["mask"] = os.path.relpath(view.mask, folder / "masks")
        entries.append(entry)
    return write_json(path, "refine", {"convention": CONVENTION, "views": entries})


def _camera(entry: dict[str, Any], where: str) -> Camera:
    """The camera of an entry; InputError where it is none, or its image has no name."""
    absent = [key for key in _KNOWN if key not in entry and key not in ("mask", "name")]
    if absent:
        raise InputError(f"{where}: {absent[0]!r} is missing")
    if not isinstance(entry["image"], str) or not entry["image"]:
        raise InputError(f"{where}: image is {short(entry['image'])}, expected the name of a photo")
    K = intrinsics(*(untrusted.number(entry[key], f"{where}: {key}") for key in ("fx", "fy", "cx", "cy")))
    pose = untrusted.matrix(entry["world_to_camera"], 4, 4, f"{where}: world_to_camera")
    return untrusted.pinhole(K, pose, entry["width"], entry["height"], entry["image"])
