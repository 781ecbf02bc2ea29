"""NumPy's files, .npy and .npz: headers are checked before anything is unpacked, nothing is unpickled; thread-safe.

NumPy parses a header with `ast.literal_eval`, which in CPython 3.11 fails now and then when two threads are in it
("AST constructor recursion depth mismatch"): only one is let in. Unpacking, which takes longer, goes on meanwhile.
"""

import io
import math
import os
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.images import as_photo
from pagas_cl.system.files import DAMAGE, MOST_BYTES, digest_file, digest_of, opened, translated

_HEADER = 1 << 16           # bytes of an array's header at most
_BEYOND = 0.1               # of 0 to 1, by which resampling leaves values of a photo
_HELD = 3                   # whole arrays that are kept: depth, confidence, photos of one file
_one_header = Lock()


def npy_shape(path: str | Path) -> tuple[int, ...]:
    """Shape of the array of a .npy file, by its header; one of DAMAGE where it holds none."""
    with opened(path) as file:
        return _npy_header(file)[0]


def read_npy(path: str | Path) -> np.ndarray:
    """The array of a .npy file; one of DAMAGE where it holds none."""
    with _one_header, opened(path) as file:
        values = np.load(file, allow_pickle=False)
    if not isinstance(values, np.ndarray):
        raise ValueError("it holds no array")
    return values


def _npy_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and dtype; `file` is then at the numbers."""
    header = np.lib.format
    with _one_header:
        read = header.read_array_header_1_0 if header.read_magic(file) == (1, 0) else header.read_array_header_2_0
        return read(file)


def first_shape(path: str | Path) -> tuple[int, ...]:
    """Shape of the array that read_first reads, by its header."""
    with opened(path) as file:
        return _member_header(*_first(file))[0]


def read_first(path: str | Path) -> np.ndarray:
    """The array "depth" of a .npz archive, or its first; one of DAMAGE where it holds none."""
    with opened(path) as file:
        return read_member(*_first(file))


def _first(file: BinaryIO) -> tuple[zipfile.ZipFile, zipfile.ZipInfo]:
    if not zipfile.is_zipfile(file):   # NumPy would speak of pickled data
        raise ValueError("it is no .npz archive; the file is damaged or cut off: write it again")
    archive = zipfile.ZipFile(file)
    members = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
    if not members:
        raise ValueError("it holds no array")
    return archive, next((entry for entry in members if entry.filename == "depth.npy"), members[0])


def _member_header(archive: zipfile.ZipFile,
                   entry: zipfile.ZipInfo) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """As _npy_header, and where the numbers begin. Only a header's length is unpacked: a few megabytes may unpack to
    any number of gigabytes."""
    with archive.open(entry) as packed:
        raw = io.BytesIO(packed.read(_HEADER))
    shape, fortran, dtype = _npy_header(raw)
    start = raw.seek(0, os.SEEK_CUR)
    count, left = math.prod(shape), entry.file_size - start
    if dtype.hasobject or count * dtype.itemsize != left:
        raise ValueError(f"its header says {shape} of {dtype}, expected what fills the {left} bytes that follow")
    return shape, fortran, dtype, start


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """One array of an archive, nothing unpickled; one of DAMAGE where it is none, or is larger than MOST_BYTES."""
    shape, fortran, dtype, start = _member_header(archive, entry)
    if entry.file_size > MOST_BYTES:
        raise ValueError(f"it unpacks to {entry.file_size / 1e9:.1f} GB, expected at most {MOST_BYTES / 1e9:.1f}")
    values = np.frombuffer(archive.read(entry), dtype, math.prod(shape), start)
    return values.reshape(shape, order="F" if fortran else "C")


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
        return _member_header(archive, archive.getinfo(f"{member}.npy"))[0]


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
        if values.dtype.kind == "f" and values.min() > -_BEYOND and values.max() < 1 + _BEYOND:
            values = np.clip(values, 0, 1)
        return as_photo(values, str(self.ref))
