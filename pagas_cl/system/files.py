"""Files of any kind: reading with a limit, hashes of inputs, and writing such that no name ever holds half a file.
"""

import filecmp
import hashlib
import os
import secrets
import stat
import struct
import sys
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from pagas_cl.errors import InputError, OutputError, PagasError, as_path

MOST_BYTES = 1 << 31       # of one array: a depth map of 268 megapixels of float64
# what numpy, zipfile, Pillow, json, struct and XML parsers raise on damaged files, as fuzzing found it
DAMAGE = (OSError, ValueError, EOFError, LookupError, SyntaxError, MemoryError, RuntimeError, OverflowError,
          zipfile.BadZipFile, zlib.error, tokenize.TokenError, struct.error, expat.ExpatError)
_CHUNK = 1 << 22            # bytes that are hashed at a time


@contextmanager
def translated(before: str, after: str = "", damage: tuple[type[Exception], ...] = DAMAGE) -> Iterator[None]:
    """Context: what is raised on damaged files becomes an InputError that says `before`, the reason, `after`."""
    try:
        yield
    except InputError:
        raise
    except damage as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
        raise InputError(f"{before}{reason}{after}") from error


@contextmanager
def opened(path: str | Path, most: int = MOST_BYTES) -> Iterator[BinaryIO]:
    """Context: a regular file of at most `most` bytes, open for reading.

    InputError for what is none: a pipe waits for who writes, a device may have no end. OSError where it cannot be
    opened.
    """
    without_waiting = getattr(os, "O_NONBLOCK", 0)
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | without_waiting)) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path} is no regular file (a pipe, a device or the like), and is not read")
        if found.st_size > most:
            raise InputError(f"{path} has {found.st_size} bytes, expected at most {most}: is it the right file?")
        yield file


def read_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """All of a file; as `opened`."""
    with opened(path, most) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)
    if len(data) > size:      # a system's own files do not say how long they are
        raise InputError(f"{path} holds more than the {size} bytes that it has: is it the right file?")
    return data


def digest_of(parts: Iterable[bytes | npt.NDArray[np.uint8]]) -> str:
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


def write_arrays(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> str:
    """Write a .npz as numpy.savez does, but without copies, which would hold up other threads; its `sum_of`."""
    header = np.lib.format
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            array = np.asarray(array, order="C")
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header.write_array_header_1_0(member, header.header_data_from_array_1_0(array))
                member.write(array.reshape(-1).view(np.uint8).data)
        return _sum(archive)


def sum_of(path: Path) -> str:
    """Names, sizes and CRCs of the arrays in a .npz, all of which are read: something else where one is damaged, an
    error of DAMAGE where it is no archive."""
    with opened(path) as file, zipfile.ZipFile(file) as archive:
        return f"{archive.testzip() or ''}{_sum(archive)}"


def _sum(archive: zipfile.ZipFile) -> str:
    return " ".join(f"{entry.filename} {entry.file_size} {entry.CRC:08x}" for entry in archive.infolist())


_ADVICE = "make room, or choose another place"


@contextmanager
def writing(path: str | Path, advice: str = _ADVICE) -> Iterator[None]:
    """Context: what goes wrong while writing to `path`, as an OutputError of one sentence that ends with `advice`."""
    try:
        yield
    except PagasError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {str(path)!r}: {error.strerror or error}; {advice}") from error


@contextmanager
def replaced(path: str | Path, suffix: str = "", parts: Path | None = None, advice: str = _ADVICE,
             durable: bool = True) -> Iterator[Path]:
    """Context: a new file to write to, in the folder `parts` (by default that of `path`), its name ending in `suffix`;
    when all of it is on the disk it gets the name `path` (unless `durable`, when it is written: who reads it has to
    find out whether a crash has lost it). Folders are made.

    OutputError, with `advice`, where the disk does not take it.
    """
    path = Path(path)
    with writing(path, advice):
        for folder in (path.parent, parts or path.parent):
            folder.mkdir(parents=True, exist_ok=True)
        # new, of a name that nobody foresees: in a folder of several users another one may have put a link there
        new = (parts or path.parent) / f".{path.name[:40]}.{secrets.token_hex(6)}.part{suffix}"
        try:        # Ctrl-C may come while a busy disk makes it
            os.close(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield new
            _rename(new, path, durable)
        finally:
            new.unlink(missing_ok=True)


@contextmanager
def replaced_with_others(path: str | Path) -> Iterator[Path]:
    """Context: `path`'s name in a new folder, for those who write others next to it (materials) or below (textures).

    When all is written each file gets its place, `path` the last. A file that is there with other bytes was not written
    by pagas_cl: then nothing is replaced, all goes into a folder of its own, and OutputError says where it is.
    """
    path = Path(path)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", suffix=".part", dir=path.parent) as new:
            yield Path(new) / path.name
            taken = differing(Path(new), path)
            folder = Path(tempfile.mkdtemp(prefix=f"{path.stem}~", dir=path.parent)) if taken else path.parent
            for file in sorted(_files(Path(new)), key=lambda file: file.name == path.name):
                place = folder / file.relative_to(new)
                place.parent.mkdir(parents=True, exist_ok=True)
                _rename(file, place)
            if taken:
                raise OutputError(f"{taken[0]} is there and was not written by pagas_cl: the mesh and its files are "
                                  f"in {folder}")


def _rename(file: Path, name: Path, durable: bool = True) -> None:
    """Only when its bytes are on the disk: the name would survive a crash without them."""
    if durable:
        with open(file, "r+b") as opened_again:
            os.fsync(opened_again.fileno())
    os.replace(file, name)


def differing(folder: Path, path: Path) -> list[str]:
    """Names next to `path`, its own excepted, that are taken by files with other bytes than those in `folder`."""
    places = [(file, path.parent / file.relative_to(folder)) for file in _files(folder) if file.name != path.name]
    return [str(place) for file, place in places
            if place.exists() and (not place.is_file() or not filecmp.cmp(file, place, shallow=False))]


def _files(folder: Path) -> list[Path]:
    """All files in a folder and below, where some meshes have their textures."""
    return [file for file in sorted(folder.rglob("*")) if file.is_file()]


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file whole, UTF-8, its lines ended as on Linux: MeshLab misreads matrices of a project that has
    Windows' ends; returns its path. OutputError where the disk does not take it."""
    path = as_path("path", path)
    with replaced(path) as new:
        new.write_text(text, "utf-8", "backslashreplace", newline="\n")     # names of files may be no text
    return path
