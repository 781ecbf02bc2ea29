"""Hashes of arrays and files, by which inputs are told apart."""

import hashlib
import os
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError
from pagas_cl.scene.files import opened

_CHUNK = 1 << 22


def digest_of(parts: Iterable[bytes | npt.NDArray[np.uint8]]) -> str:
    """Hash of bytes that come in parts."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)      # type: ignore[arg-type]
    return digest.hexdigest()


def digest_array(array: np.ndarray) -> str:
    """Hash of an array's shape, type and values."""
    values = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return digest_of([f"{array.dtype.str}{array.shape}".encode(), values])


def digest_file(path: str | Path) -> str:
    """Hash of a file's bytes; read once a process while size and time of change stay."""
    try:
        now = os.stat(path)
        return _digest_file(str(path), now.st_size, now.st_mtime_ns)
    except OSError as error:
        raise InputError(f"file {str(path)!r} cannot be read: {error.strerror or error}") from error


@lru_cache(maxsize=1 << 17)
def _digest_file(path: str, size: int, changed: int) -> str:
    with opened(path, sys.maxsize) as file:
        return digest_of(iter(lambda: file.read(_CHUNK), b""))
