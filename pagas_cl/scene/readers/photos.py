"""Finding the photos that a camera file speaks of, inside the scene's folder alone unless the caller allows others."""

import os
from collections.abc import Callable, Iterable, Sequence
from os.path import isdir, isfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pagas_cl.errors import InputError, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.images import has_alpha, image_size, open_image, orientation_of
from pagas_cl.scene.names import file_stems
from pagas_cl.scene.untrusted import IMAGE_SUFFIXES, MAX_SIDE
from pagas_cl.scene.view import Scene, View, file_behind

_KEEP_SIZE = (2, 3, 4)      # of the orientations of EXIF: upside down or mirrored
_ROUNDED = 2e-3             # of the distance from a camera to the next: some tenths of a pixel
_WITH_ALPHA = (".png", ".tif", ".tiff", ".webp")
FOLDERS = ("images", "image", "color", "rgb", "blended_images")


class Format(NamedTuple):
    """A reader of a module that has several."""

    EXPECTED: str
    detect: Callable[[Path], Any]
    read: Callable[..., Scene]


def existing(path: Path, what: str) -> Path:
    """`path` if it is a file, else InputError."""
    if not isfile(path):
        raise InputError(f"{what}: there is no file {short(str(path))}")
    return path


def named(folder: Path, name: Any, what: str, outside: bool) -> Path:
    """The file that a scene's file names; as `untrusted.inside`, and InputError where it is not there."""
    return existing(untrusted.inside(folder, name, what, outside=outside), what)


def first_file(folder: Path, names: Iterable[str | Path]) -> Path | None:
    """The first of `names` that is a file in `folder`."""
    return next((folder / name for name in names if isfile(folder / name)), None)


def list_photos(folder: Path) -> list[Path]:
    """Image files of `folder`, by name; hidden files left out."""
    if not isdir(folder):
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def scene_photos(folder: Path, names: tuple[str, ...] = FOLDERS) -> list[Path]:
    """Photos of the first of the sub-folders `names` that has any, else of `folder` itself; InputError if none."""
    for place in (*names, "."):
        if photos := list_photos(folder / place):
            return photos
    raise InputError(f"{folder} has no photos: looked in {', '.join(names)} and the folder itself for "
                     f"{' '.join(IMAGE_SUFFIXES)}")


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height from the file's header, in pixels; the pixels are not decoded."""
    width, height = image_size(path)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InputError(f"image {str(path)!r} claims {width} x {height} pixels: is the file damaged?")
    return width, height


def find_mask(folder: Path, photo: Path, places: tuple[str, ...] = ("masks", "mask"), name: str = "") -> Path | None:
    """The mask of `photo`: <place>/<name>.png or <stem>.png, with folders of `name` or without; 007 for 000007."""
    whole = Path(name or photo.name)
    for place in places:
        named = first_file(folder / place, (f"{whole}.png", f"{whole.with_suffix('')}.png", photo.name + ".png",
                                            photo.stem + ".png"))
        if named:
            return named
        if photo.stem.isdecimal():
            for path in list_photos(folder / place):
                if path.stem.isdecimal() and int(path.stem) == int(photo.stem):
                    return path
    return None


def refuse_shared_masks(views: Iterable[View], folder: Path) -> None:
    """InputError where one mask was found by the names of two photos: `0001.png` of left/0001.png and right/0001.png.
    One that a file of the scene names for several photos is nobody's mistake."""
    found: dict[Path, View] = {}
    for view in views:
        photo, mask = file_behind(view.image), file_behind(view.mask)
        if mask is not None and photo is not None and mask == find_mask(folder, photo, name=view.name):
            other = found.setdefault(mask, view)
            if other is not view:
                raise InputError(f"mask {str(mask)!r} could be of view {other.name!r} and of {view.name!r}: give each "
                                 f"one of its own, {mask.parent / other.name}.png and {mask.parent / view.name}.png")


def check_masks(views: Sequence[View], masks: Path) -> None:
    """InputError where a folder of masks has none of any view; logs which views have none."""
    without = [view.name for view in views if view.mask is None]
    if masks.is_dir() and len(without) == len(views):
        raise InputError(f"no mask in {str(masks)!r} belongs to any photo; expected names like "
                         f"{file_stems([view.name for view in views])[0]}.png or {views[0].name}.png")
    if masks.is_dir() and without:
        log.warning("%d of %d views have no mask in %s and are used whole: %s", len(without), len(views), masks,
                    ", ".join(map(short, without[:5])))


def names_of(photos: Sequence[Path]) -> list[str]:
    """What views of these photos are called: as the files, with the folders that differ where two share a name."""
    names = [path.name for path in photos]
    if untrusted.twice(names) is None:
        return names
    top = os.path.commonpath([path.parent for path in photos])
    return [path.relative_to(top).as_posix() for path in photos]


def one_photo_each(photos: list[Path], count: int, what: str) -> list[Path]:
    """`photos` if there are `count` of them, else InputError: the file names none, so that order is all there is."""
    if len(photos) != count:
        raise InputError(f"{what} has {count} cameras and {photos[0].parent} has {len(photos)} photos; the file names "
                         "no photos, so that there must be exactly one a camera, in the order of their names")
    return photos


def file_of(view: View) -> Path:
    """The photo's file, which the formats that name files ask for."""
    if not isinstance(view.image, Path):
        raise InputError(f"view {view.name!r}: its photo is no file; the format names files, so save it first")
    return view.image


def warn_of_rounding(positions: Sequence[str], path: Path) -> None:
    """Say where positions of cameras, in a file's text, have six digits, as MeshLab writes them, and these are too few:
    at map coordinates cameras move by many pixels."""
    places = np.array([untrusted.floats(text, f"{path}: position")[:3] for text in positions]).reshape(-1, 3)
    digit = 10.0 ** (np.floor(np.log10(np.abs(places).max(initial=1e-9))) - 5)
    apart = np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)) if len(places) > 1 else np.inf
    if places.any() and digit > _ROUNDED * apart and all(float(f"{x:.6g}") == x for x in places.flat):
        log.warning("%s: positions of cameras are rounded to %g units, and cameras are %.3g units apart: MeshLab "
                    "writes six digits, so move cameras and mesh near to 0 before they go there", path, digit, apart)


def view_of(folder: Path, camera: Camera, photo: Path, mask: Path | None = None, name: str = "") -> View:
    """The view of `photo` with its mask, given or found; InputError where a file's size is not the camera's."""
    view = View(camera, photo, mask or find_mask(folder, photo, name=name), name or photo.name)
    view.check_files()
    return view


def warn_of_links(files: Iterable[Path], folder: Path) -> None:
    """Log which of a scene's files a symbolic link takes out of its `folder` (or that of its file).

    Whoever owns the disk makes links, or whoever packed the scene: they are read, and the log says where from.
    """
    top = folder if folder.is_dir() else folder.parent
    found = [path for path in files if Path(os.path.abspath(path)).is_relative_to(os.path.abspath(top))
             and not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(top))]
    if found:
        log.warning("%d photos, masks or depth maps of scene %s lie outside it, through symbolic links: %s is %s; do "
                    "not go on if you do not know who made the links", len(found), folder, found[0],
                    os.path.realpath(found[0]))


def warn_of_unused(photos: Sequence[Path]) -> None:
    """Log what is not used, as by COLMAP: alpha channels, and EXIF orientations that no size of a photo rules out."""
    with_alpha = [path for path in photos if path.suffix.lower() in _WITH_ALPHA and has_alpha(path)]
    if with_alpha:
        log.warning("%d of %d photos have an alpha channel, which is not used (the first is %s): to leave out what is "
                    "transparent, give masks/%s.png, white = used", len(with_alpha), len(photos),
                    with_alpha[0], with_alpha[0].stem)
    turned = []
    for path in photos:
        with open_image(path) as image:
            if orientation_of(image) in (_KEEP_SIZE if image.width != image.height else range(2, 9)):
                turned.append(path)
    if turned:
        log.warning("%d of %d photos have an EXIF orientation, by which some programs turn or mirror them (the first "
                    "is %s): here they are used as stored, as by COLMAP; where the cameras are of turned photos, save "
                    "the photos turned", len(turned), len(photos), turned[0])
