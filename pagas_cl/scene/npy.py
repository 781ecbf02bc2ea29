"""NumPy's files, read by several threads at a time.

NumPy parses a header with `ast.literal_eval`, which in CPython 3.11 fails now and then when two threads are in it
("AST constructor recursion depth mismatch"): only one is let in. Unpacking, which takes longer, goes on beside it.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from threading import Lock

import numpy as np

MOST_BYTES = 1 << 31       # of one array: a depth map of 268 megapixels of float64

_one_header = Lock()


def read_npy(path: str | Path) -> np.ndarray:
    """The array of a .npy file; ValueError, OSError or EOFError where it holds none."""
    with _one_header:
        values = np.load(path, allow_pickle=False)
    if not isinstance(values, np.ndarray):
        raise ValueError("it holds no array")
    return values


def read_first(path: str | Path) -> np.ndarray:
    """The first array of a .npz archive; ValueError, OSError or zipfile.BadZipFile where it holds none."""
    if not zipfile.is_zipfile(path):   # NumPy would speak of pickled data
        raise ValueError("it is no .npz archive; the file is damaged or cut off: write it again")
    with zipfile.ZipFile(path) as archive:
        members = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
        if not members:
            raise ValueError("it holds no array")
        unpacked = max(entry.file_size for entry in members)
        if unpacked > MOST_BYTES:      # a few megabytes may unpack to any number of gigabytes
            raise ValueError(f"it unpacks to {unpacked / 1e9:.1f} GB, a depth map has at most {MOST_BYTES / 1e9:.1f}")
        raw = io.BytesIO(archive.read(members[0]))
    with _one_header:
        return np.lib.format.read_array(raw, allow_pickle=False)
