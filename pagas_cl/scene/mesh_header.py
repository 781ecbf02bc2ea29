"""What a mesh file claims to hold, against its size: memory is asked for by the claim, before anything is read."""

from __future__ import annotations

import re
from pathlib import Path

from pagas_cl.errors import InputError

_HEADER = 1 << 16         # bytes of a file in which its header must end
_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4,
          "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8}


def check_claims(path: Path) -> None:
    """InputError where a .ply or .off file claims more elements than it has bytes, or a binary .ply is cut off."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER)
    counts = _claimed(head)
    if sum(counts) > size:
        raise InputError(f"mesh {str(path)!r} claims {sum(counts)} vertices and faces but has {size} bytes: is the "
                         "file damaged or cut off?")
    least = _least_bytes(head)
    if least > size:
        raise InputError(f"mesh {str(path)!r} has {size} bytes, and what its header claims takes {least} or more: the "
                         "file is cut off, copy or write it again")


def _claimed(head: bytes) -> list[int]:
    """Numbers of elements that the first bytes of a mesh file claim; none where the format claims none."""
    if head[:3] == b"ply":
        header = head.partition(b"end_header")[0]
        return [int(n) for n in re.findall(rb"^\s*element\s+\S+\s+(\d{1,20})", header, re.M)]
    off = re.match(rb"\s*(?:ST|C|N|4|n)*OFF\s*(?:#[^\n]*\n\s*)*(\d{1,20})\s+(\d{1,20})", head)
    if off:
        return [int(n) for n in off.groups()]
    return []


def _least_bytes(head: bytes) -> int:
    """Fewest bytes that a binary .ply with this header has, its faces triangles; 0 for what is none."""
    header, end, _ = head.partition(b"end_header")
    if head[:3] != b"ply" or not end or b"format binary" not in header:
        return 0
    least, count = len(header) + len(end) + 1, 0  # its line's end
    for words in (line.split() for line in header.decode("ascii", "replace").splitlines()):
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            count = int(words[2])
        elif words[:2] == ["property", "list"] and len(words) == 5:
            corners = 3 if words[4] in ("vertex_indices", "vertex_index") else 0
            least += count * (_BYTES.get(words[2], 0) + corners * _BYTES.get(words[3], 0))
        elif words[:1] == ["property"] and len(words) == 3:
            least += count * _BYTES.get(words[1], 0)
    return least
