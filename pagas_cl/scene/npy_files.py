"""NumPy's files, .npy and .npz, of any origin: headers are checked before anything is unpacked, nothing is unpickled;
read by several threads at a time.

NumPy parses a header with `ast.literal_eval`, which in CPython 3.11 fails now and then when two threads are in it
("AST constructor recursion depth mismatch"): only one is let in. Unpacking, which takes longer, goes on meanwhile.
"""

import io
import math
import os
import zipfile
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np

from pagas_cl.system.files import MOST_BYTES, opened

_HEADER = 1 << 16           # bytes of an array's header at most
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
        return member_shape(*_first(file))


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


def member_shape(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[int, ...]:
    """Shape of an array of an archive, by its header; one of DAMAGE where it is none."""
    return _member_header(archive, entry)[0]


def _member_header(archive: zipfile.ZipFile,
                   entry: zipfile.ZipInfo) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """As _npy_header, and where the numbers begin. All that is unpacked is a header's length: a few megabytes may
    unpack to any number of gigabytes."""
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
