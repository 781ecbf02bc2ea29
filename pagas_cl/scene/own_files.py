"""Files that pagas_cl has written are recognized by a mark in them; no other file is replaced unless a user says so.

JSON files: {"pagas_cl": version, "command": ..., what was measured}. Files of text (.html, .mlx, .mlp) and pictures:
`TEXT_MARK`, near the beginning. Meshes: `TEXT_MARK` as a comment (.off: the last), header, or generator.
"""

import json
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.config.version import __version__
from pagas_cl.system.files import DAMAGE, opened, read_bytes, write_text

TEXT_MARK = "written by pagas_cl"
_MESH_MARK = re.compile(rf'^(?:comment |# ){TEXT_MARK}\r?$|\A{TEXT_MARK}\b|"generator"\s*:\s*"{TEXT_MARK}"'.encode(),
                        re.MULTILINE)
_HEAD, _TAIL = 1 << 12, 64     # bytes at the beginning of a file, and the end of a mesh, that have its mark
_MOST_BYTES = 1 << 28     # of a file that is read to recognize it: a longer one is foreign


def json_text(command: str, content: Mapping[str, Any]) -> str:
    """`content` as every command writes it; null for numbers that JSON does not have."""
    own = {"pagas_cl": __version__, "command": command, **content}
    return json.dumps(_finite(own), indent=1, allow_nan=False) + "\n"


def write_json(path: str | Path, command: str, content: Mapping[str, Any]) -> Path:
    """Write `json_text`, whole or not at all; OutputError where the disk does not take it."""
    return write_text(path, json_text(command, content))


def is_own_json(path: str | Path) -> bool:
    """Whether `path` is a JSON file that `write_json` has written."""
    try:
        found = json.loads(read_bytes(path, _MOST_BYTES))
    except DAMAGE:
        return False
    return isinstance(found, dict) and "pagas_cl" in found


def is_own_text(path: str | Path) -> bool:
    """Whether `path` has the mark of a file of text, or a picture, that pagas_cl has written."""
    return TEXT_MARK.encode() in _ends(path, 0)


def is_own_mesh(path: str | Path) -> bool:
    """Whether `path` has the mark of a mesh that pagas_cl has written; not where it cannot be read."""
    return _MESH_MARK.search(_ends(path, _TAIL)) is not None


def _ends(path: str | Path, tail: int) -> bytes:
    """The first bytes of a file of any size, and the last `tail` ones; none where it cannot be read."""
    try:
        with opened(path, sys.maxsize) as file:
            head = file.read(_HEAD)
            file.seek(max(len(head), file.seek(0, os.SEEK_END) - tail))
            return head + file.read()
    except DAMAGE:
        return b""


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
