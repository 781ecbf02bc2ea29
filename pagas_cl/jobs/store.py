"""Arrays in a folder, under the hash of their content: what a task may refer to from any process or machine."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.jobs.disk import written
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.files import read_npy

_CHUNK = 1 << 22


def digest_array(array: np.ndarray) -> str:
    """Hash of an array's shape, type and values."""
    digest = hashlib.blake2b(f"{array.dtype.str}{array.shape}".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8))
    return digest.hexdigest()


def digest_file(path) -> str:
    """Hash of a file's bytes; read once a process while size and time of change stay."""
    try:
        now = os.stat(path)
        return _digest_file(str(path), now.st_size, now.st_mtime_ns)
    except OSError as error:
        raise InputError(f"file {str(path)!r} cannot be read: {error.strerror or error}") from error


@lru_cache(maxsize=1 << 17)
def _digest_file(path: str, size: int, changed: int) -> str:
    digest = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while part := file.read(_CHUNK):
            digest.update(part)
    return digest.hexdigest()


@dataclass(frozen=True)
class StoredArray:
    """An array on disk. May stand for a view's image or mask, or for a depth map."""

    file: Path
    digest: str

    def load(self) -> np.ndarray:
        """The array; InputError where the file is gone or is not what was stored."""
        try:
            array = read_npy(self.file)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"stored array {str(self.file)!r} cannot be read ({error}): start the same command again, "
                             "which writes it anew") from error
        if digest_array(array) != self.digest:
            raise InputError(f"stored array {str(self.file)!r} is damaged: delete it and start the same command again")
        return array


@dataclass(frozen=True)
class DepthFile:
    """A depth map's file, resampled to `size` (width, height) when it is loaded."""

    file: Path
    size: tuple[int, int]
    scale: float | None = None

    @property
    def digest(self) -> str:
        return f"{digest_file(self.file)} {self.size} {self.scale}"

    def load(self) -> np.ndarray:
        return load_depth(self.file, self.size, scale=self.scale)


class Store:
    """A folder of arrays; made when the first one comes."""

    def __init__(self, folder):
        self.folder = Path(folder)

    def put(self, array: np.ndarray) -> StoredArray:
        """Write `array` unless it is there already, whole."""
        digest = digest_array(array)
        path = self.folder / f"{digest}.npy"
        array = np.ascontiguousarray(array)
        if not (path.is_file() and path.stat().st_size >= array.nbytes + 64 and _same(path, digest)):
            with written(path) as file:
                np.save(file, array)
        return StoredArray(path, digest)


def _same(path: Path, digest: str) -> bool:
    try:
        StoredArray(path, digest).load()
    except InputError:
        return False
    return True
