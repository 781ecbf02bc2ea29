"""Arrays inside files of any origin (.npz members, .npy), or one row of them; nothing is unpickled."""

import os
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.images import as_photo
from pagas_cl.scene.npy_files import member_shape, npy_shape, read_member
from pagas_cl.system.files import DAMAGE, digest_file, digest_of, translated

_HELD = 3      # whole arrays that are kept: depth, confidence, photos of one file


@dataclass(frozen=True)
class ArrayRef:
    """An array on disk: `member` of an .npz, or the .npy where that is empty; the part of it at `index`, or all."""

    file: Path
    member: str = ""
    index: tuple[int, ...] = ()

    @property
    def digest(self) -> str:
        return digest_of([f"{digest_file(self.file)} {self.member} {self.index}".encode()])

    def __str__(self) -> str:
        return f"{self.file}" + (f", array {self.member!r}" if self.member else "")

    def part(self, k: int) -> "ArrayRef":
        """What is at place `k` of its first axis."""
        return ArrayRef(self.file, self.member, (*self.index, k))

    @property
    def shape(self) -> tuple[int, ...]:
        """Of what `load` gives, by the file's header; InputError where the file is damaged."""
        with translated(f"{self} cannot be read: ", "; is the file damaged?"):
            return _shape(self.file, self.member, os.stat(self.file).st_mtime_ns)[len(self.index):]

    def load(self) -> np.ndarray:
        """The numbers; InputError where the file is damaged or holds fewer rows."""
        with translated(f"{self} cannot be read: ", "; is the file damaged?"):
            whole = _whole(self.file, self.member, os.stat(self.file).st_mtime_ns)
            if whole.dtype.kind not in "fiub":
                raise ValueError(f"it has dtype {whole.dtype}, expected numbers")
            if whole.ndim < len(self.index) or any(n <= k for n, k in zip(whole.shape, self.index)):
                raise ValueError(f"it has shape {whole.shape}, expected one with a place {self.index}")
            return np.asarray(whole[self.index]) if self.index else whole


@lru_cache(maxsize=_HELD)
def _whole(file: Path, member: str, changed: int) -> np.ndarray:
    if not member:      # mapped, so that a row is all that is read
        mapped: np.ndarray = np.load(file, mmap_mode="r", allow_pickle=False)
        return mapped
    with zipfile.ZipFile(file) as archive:
        return read_member(archive, archive.getinfo(f"{member}.npy"))


@lru_cache(maxsize=1024)
def _shape(file: Path, member: str, changed: int) -> tuple[int, ...]:
    if not member:
        return npy_shape(file)
    with zipfile.ZipFile(file) as archive:
        return member_shape(archive, archive.getinfo(f"{member}.npy"))


def members(file: Path) -> list[str]:
    """Names of the arrays of an .npz; none where it is no archive."""
    try:
        with zipfile.ZipFile(file) as archive:
            return [name[:-4] for name in archive.namelist() if name.endswith(".npy")]
    except DAMAGE:
        return []


@dataclass(frozen=True)
class PhotoInArray:
    """A photo inside an array: (H, W, 3), (3, H, W), or either behind axes of length 1; 8 bit, or 0 to 1."""

    ref: ArrayRef

    @property
    def digest(self) -> str:
        return self.ref.digest

    def load(self) -> np.ndarray:
        """uint8 (H, W, 3)."""
        values = self.ref.load()
        while values.ndim > 3 and values.shape[0] == 1:
            values = values[0]
        if values.ndim == 3 and values.shape[0] == 3 and values.shape[2] != 3:
            values = np.moveaxis(values, 0, -1)
        if values.ndim != 3 or values.shape[2] != 3:
            raise InputError(f"{self.ref}: a photo has shape {values.shape}, expected (height, width, 3)")
        return as_photo(np.clip(values, 0, 1) if values.dtype.kind == "f" else values, str(self.ref))
