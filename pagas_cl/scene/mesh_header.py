"""What a mesh file claims to hold, against its size: memory is asked for by the claim, before anything is read."""

from __future__ import annotations

import re
from pathlib import Path

from pagas_cl.errors import InputError

_HEADER = 1 << 16         # bytes of a file in which its header must end


def check_claims(path: Path) -> None:
    """InputError where a .ply or .off file claims more elements than it has bytes."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER)
    counts = _claimed(head)
    if sum(counts) > size:
        raise InputError(f"mesh {str(path)!r} claims {sum(counts)} vertices and faces but has {size} bytes: is the "
                         "file damaged or cut off?")


def _claimed(head: bytes) -> list[int]:
    """Numbers of elements that the first bytes of a mesh file claim; none where the format claims none."""
    if head[:3] == b"ply":
        header = head.partition(b"end_header")[0]
        return [int(n) for n in re.findall(rb"^\s*element\s+\S+\s+(\d{1,20})", header, re.M)]
    off = re.match(rb"\s*(?:ST|C|N|4|n)*OFF\s*(?:#[^\n]*\n\s*)*(\d{1,20})\s+(\d{1,20})", head)
    if off:
        return [int(n) for n in off.groups()]
    return []
