"""What is worth keeping of this machine from one run to the next, in the user's cache: facts, as JSON files."""

import hashlib
import json
from pathlib import Path
from typing import Any

from platformdirs import user_cache_dir

from pagas_cl.errors import log
from pagas_cl.system.files import read_bytes, replaced

_MOST = 1_000_000                          # bytes that such a file may have
_in_memory: dict[Path, dict[str, Any]] = {}   # the same cache where the disk takes none


def folder() -> Path:
    """Where they are; it need not exist."""
    return Path(user_cache_dir("pagas_cl", appauthor=False))


def digest(*parts: Any) -> str:
    """A short name for what `parts` (plain JSON values) say."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def read(kind: str, key: str) -> dict[str, Any] | None:
    """What was kept, or None: nothing, or nothing that can be read, which is then found out anew."""
    path = folder() / kind / f"{key}.json"
    if path in _in_memory:
        return _in_memory[path]
    try:
        value = json.loads(read_bytes(path, _MOST))
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def write(kind: str, key: str, value: dict[str, Any]) -> None:
    """Keep `value` under `key`; for the life of this process alone where the disk does not take it."""
    path = folder() / kind / f"{key}.json"
    try:
        write_whole(path, json.dumps(value, indent=1).encode())
        _in_memory.pop(path, None)
    except OSError as error:
        _in_memory[path] = value
        log.info("every run starts some seconds later than it could, since nothing can be stored (%s): make %s "
                 "writable, or name another folder with XDG_CACHE_HOME", error, folder())


def write_whole(path: Path, data: bytes) -> None:
    """A file in a folder of the user alone, there as a whole or not at all; OSError where it cannot be."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with replaced(path) as new:
        new.write_bytes(data)
