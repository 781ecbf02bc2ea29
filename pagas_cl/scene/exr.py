"""One channel of an OpenEXR file: scan lines, not compressed or by ZIP, as phones and renderers write depth.

The first of R, Y, Z, V, G, B that is there; 16 or 32 bit floating point.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError

_MAGIC, _TILED_OR_DEEP = 20000630, 0x200 | 0x800 | 0x1000
_ROWS = {0: 1, 2: 1, 3: 16}        # compression: rows of a block
_TYPES = {0: "<u4", 1: "<f2", 2: "<f4"}
_WANTED = ("R", "Y", "Z", "V", "G", "B")
_MOST = 1 << 28                    # pixels


def read_exr(path: Path) -> np.ndarray:
    """The channel as (H, W) float32; one of scene.files.DAMAGE, or InputError, where there is none."""
    data = path.read_bytes()
    magic, version = struct.unpack_from("<II", data)
    if magic != _MAGIC or version & _TILED_OR_DEEP:
        raise ValueError("it is no OpenEXR file of scan lines")
    attributes, place = _attributes(data, 8)
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    compression, channels = attributes["compression"][0], _channels(attributes["channels"])
    if compression not in _ROWS:
        raise InputError(f"{path} is compressed by method {compression}, expected none or ZIP; convert it")
    if width < 1 or height < 1 or width * height > _MOST:
        raise ValueError(f"its data window is {width} x {height}")
    name = next((n for n in _WANTED for given, _ in channels if given == n), None)
    if name is None:
        raise ValueError(f"its channels are {', '.join(n for n, _ in channels)}, expected one of {', '.join(_WANTED)}")
    rows, stride = _ROWS[compression], sum(np.dtype(t).itemsize for _, t in channels) * width
    blocks = -(-height // rows)
    out = np.zeros((height, width), np.float32)
    for block, offset in enumerate(struct.unpack_from(f"<{blocks}Q", data, place)):
        y, size = struct.unpack_from("<ii", data, offset)
        count = min(rows, height - block * rows)
        if y - top != block * rows or size < 0:
            raise ValueError(f"block {block} says that it begins at row {y}")
        raw = data[offset + 8:offset + 8 + size]
        if compression and size < count * stride:
            raw = _unpacked(raw, count * stride)
        if len(raw) != count * stride:
            raise ValueError(f"block {block} has {len(raw)} bytes, expected {count * stride}")
        for row in range(count):
            at = row * stride
            for given, kind in channels:
                if given == name:
                    out[block * rows + row] = np.frombuffer(raw, kind, width, at)
                at += np.dtype(kind).itemsize * width
    return out


def _unpacked(raw: bytes, size: int) -> bytes:
    """ZIP of EXR: bytes as differences, first all even ones, then all odd ones."""
    found = zlib.decompressobj().decompress(raw, size)
    split = (np.cumsum(np.frombuffer(found, np.uint8).astype(np.int64) - 128) + 128).astype(np.uint8)
    half = (len(split) + 1) // 2
    mixed = np.empty_like(split)
    mixed[::2], mixed[1::2] = split[:half], split[half:]
    return mixed.tobytes()


def _attributes(data: bytes, place: int) -> tuple[dict[str, bytes], int]:
    found = {}
    while data[place] != 0:
        name, kind = place, data.index(b"\0", place) + 1
        end = data.index(b"\0", kind) + 1
        (size,) = struct.unpack_from("<i", data, end)
        if size < 0 or end + 4 + size > len(data):
            raise ValueError("an attribute ends behind the file")
        found[data[name:kind - 1].decode("latin-1")] = data[end + 4:end + 4 + size]
        place = end + 4 + size
    return found, place + 1


def _channels(data: bytes) -> list[tuple[str, str]]:
    """Names and types, in the order of the file."""
    found, place = [], 0
    while data[place] != 0:
        end = data.index(b"\0", place)
        kind, _, across, down = struct.unpack_from("<iIii", data, end + 1)
        if kind not in _TYPES or (across, down) != (1, 1):
            raise ValueError("a channel is sub-sampled or of an unknown type")
        found.append((data[place:end].decode("latin-1"), _TYPES[kind]))
        place = end + 17
    return found
