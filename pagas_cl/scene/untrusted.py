"""Reading foreign files: every limit and every check on raw values in one place.

A damaged or hostile file ends in one InputError sentence: never in a crash, a hang, or much memory.
"""

import json
import os
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, short
from pagas_cl.scene.camera import Camera, rigid
from pagas_cl.system import files

MAX_BYTES = 256 << 20      # a camera file of 100,000 views has some 100 MB
MAX_SIDE = 1 << 20         # pixels; larger sides are damage, not photos
_XML_DEPTH, _XML_BYTES = 32, 64 << 20
_UNIT = 1e-2               # by so much the length of a quaternion may differ from 1
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)  # float() would take "1_0", "nan", "inf"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")


def inside(root: Path, name: Any, what: str, *, outside: bool = False) -> Path:
    """The path `name` out of a file, where it is relative to `root`.

    InputError where it leads out of `root` without `outside`: a foreign file must not choose what is read here.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{what} is {short(name)}, expected the path of a file")
    path = Path(os.path.normpath(Path(root) / name.replace("\\", "/")))
    if not outside:
        top, absolute = Path(os.path.abspath(root)), Path(os.path.abspath(path))
        drive = os.name != "nt" and re.match("[A-Za-z]:", name)      # on Windows it is part of what is compared
        if top != absolute and top not in absolute.parents or drive:
            raise InputError(f"{what} is {short(name)}, which leads out of {root}; move the file into the folder, or "
                             "pass outside=True (--outside) if you trust this scene")
    return path


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """The whole file, or InputError where it cannot be read or is larger than `limit` bytes."""
    try:
        return files.read_bytes(path, limit)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error


def holds(path: Path, mark: bytes) -> bool:
    """Whether the mark is in a file; false where it cannot be read."""
    try:
        return mark in read_bytes(path)
    except InputError:
        return False


def read_text(path: Path, limit: int = MAX_BYTES) -> str:
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text (byte {error.start} is not UTF-8): is the file damaged?") from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file, as `json_object`."""
    return json_object(read_text(path), str(path))


def json_object(text: str, who: str) -> dict[str, Any]:
    """A JSON object; keys given twice are refused, since readers differ in which of the two they drop."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        key = twice([name for name, _ in pairs])
        if key is not None:
            raise InputError(f"{who}: the key {short(key)} is given twice in one object; remove one")
        return dict(pairs)

    with files.translated(f"{who} is not valid JSON (", "): is the file damaged?"):
        data = json.loads(text, object_pairs_hook=unique)
    if not isinstance(data, dict):
        raise InputError(f"{who} holds a JSON {type(data).__name__}, expected an object")
    return data


def read_xml(path: Path, root: str) -> ElementTree.Element:
    """The root element of an XML file, which must be called `root`.

    Entity declarations, which can expand without bound or read other files, are refused before anything is expanded; a
    DOCTYPE that leaves them to another file is, too, since unknown ones in attributes would be left out without a word.
    """
    data, builder, depth = read_bytes(path, _XML_BYTES), ElementTree.TreeBuilder(), 0

    def refuse(*_: object) -> NoReturn:
        raise InputError(f"{path} declares XML entities, or names a file that may, in its DOCTYPE; neither is read: "
                         "remove them there")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _XML_DEPTH:
            raise InputError(f"{path} nests its elements more than {_XML_DEPTH} deep: is the file damaged?")
        builder.start(name, attributes)

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name)

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = parser.UnparsedEntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = parser.NotStandaloneHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    with files.translated(f"{path} is not valid XML (", "): is the file damaged?"):
        parser.Parse(data, True)
        element = builder.close()
    if element.tag != root:
        raise InputError(f"{path}: the root element is <{element.tag[:40]}>, expected <{root}>")
    return element


def twice(values: Sequence[Hashable]) -> Hashable:
    """The first of `values` that is there twice, or None."""
    return None if len(set(values)) == len(values) else Counter(values).most_common(1)[0][0]


def number(value: Any, what: str) -> float:
    """A finite number out of a JSON value; booleans and text are refused."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{what} is {short(value)}, expected a number")
    try:
        found = float(value)
    except OverflowError:
        found = float("inf")
    if not np.isfinite(found):
        raise InputError(f"{what} is {found}, expected a finite number")
    return found


def is_number(token: str) -> bool:
    """Whether a word is a number in plain decimal spelling."""
    return _NUMBER.fullmatch(token) is not None


def float_of(token: str, what: str) -> float:
    """A finite number out of a word of a text file, in plain decimal spelling."""
    if not is_number(token):
        raise InputError(f"{what} is {short(token)}, expected a number")
    return number(float(token), what)


def floats(text: str | Sequence[str] | None, what: str, count: int | None = None) -> npt.NDArray[np.float64]:
    """The words of a text (or the words themselves) as float64 of shape (N,); N must be `count` where that is given."""
    tokens = text.split() if isinstance(text, str) else text or ()
    if count not in (None, len(tokens)):
        shown = text if text is None or isinstance(text, str) else " ".join(text)
        raise InputError(f"{what} is {short(shown)}, expected {count} numbers")
    return np.array([float_of(token, what) for token in tokens], np.float64)


def whole(value: Any, low: int, high: int, what: str) -> int:
    value = number(value, what)
    if value != int(value) or not low <= value <= high:
        raise InputError(f"{what} is {value:g}, expected a whole number from {low} to {high}")
    return int(value)


def size(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Width and height in pixels, such as a photo may have."""
    return whole(width, 1, MAX_SIDE, f"{where}: width"), whole(height, 1, MAX_SIDE, f"{where}: height")


def numbers(value: Any, count: int, what: str) -> npt.NDArray[np.float64]:
    """A JSON list of so many numbers as float64 of shape (count,)."""
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{what} is {short(value)}, expected {count} numbers")
    return np.array([number(cell, what) for cell in value], np.float64)


def matrix(value: Any, rows: int, columns: int, what: str) -> np.ndarray:
    """Nested JSON lists as float64 of shape (rows, columns)."""
    if not isinstance(value, list) or len(value) != rows or not all(
            isinstance(row, list) and len(row) == columns for row in value):
        raise InputError(f"{what} is {short(value)}, expected {rows} rows of {columns} numbers")
    return np.array([[number(cell, what) for cell in row] for row in value], np.float64)


def objects(data: dict[str, Any], key: str, one: str, path: Path,
            known: tuple[str, ...] = ()) -> list[tuple[dict[str, Any], str]]:
    """The JSON objects listed under `key`, one a photo, each with the words that a message calls it by (`one` 7)."""
    found = data.get(key)
    if not isinstance(found, list) or not found:
        raise InputError(f"{path}: {key!r} is {short(found)}, expected a list with one object a photo")
    named = [(entry, f"{path}, {one} {i}") for i, entry in enumerate(found)]
    for entry, where in named:
        if not isinstance(entry, dict):
            raise InputError(f"{where} is {short(entry)}, expected an object")
        refuse_near_misses(entry, known, where)
    return named


def refuse_near_misses(found: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    """Refuse a key that differs by one letter from a known one that is absent: a default would replace the value."""
    for key in found:
        if key in known:
            continue
        for name in known:
            if name not in found and len(name) == len(key) and sum(a != b for a, b in zip(name, key)) == 1:
                raise InputError(f"{where}: unknown key {short(key)} while {name!r} is absent; is it a slip?")


def pose(quaternion: npt.ArrayLike, shift: npt.ArrayLike, where: str) -> npt.NDArray[np.float64]:
    """(4, 4) of a quaternion x y z w, which files hold with a length of 1, and a translation x y z."""
    given = np.asarray(quaternion, np.float64)
    sane = np.isfinite(given).all() and np.abs(given).max() < 2
    length = float(np.linalg.norm(given)) if sane else np.nan
    if not abs(length - 1) < _UNIT:
        raise InputError(f"{where}: the quaternion {short(given.tolist())} has length {length:g}, expected 1")
    x, y, z, w = given / length
    return rigid([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                  [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                  [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]], shift)


def pinhole(K: npt.ArrayLike, pose: npt.ArrayLike, width: int, height: int, name: str, *,
            pixel_center: float = 0.5, camera_to_world: bool = False) -> Camera:
    """Camera.from_opencv_w2c, or from_c2w, out of a file: also refuses sizes and focal lengths of no photo."""
    size(width, height, f"camera {name!r}")
    if np.abs(np.asarray(K)).max(initial=0) > 1e9:
        raise InputError(f"camera {name!r}: K holds more than 1e9 pixels: is the file damaged?")
    if np.abs(np.asarray(pose)).max(initial=0) > 1e15:
        raise InputError(f"camera {name!r}: the pose holds values above 1e15: is the file damaged?")
    make = Camera.from_c2w if camera_to_world else Camera.from_opencv_w2c
    return make(K, pose, width, height, pixel_center=pixel_center, name=name)
