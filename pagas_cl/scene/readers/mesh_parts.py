"""Files that a mesh file names (materials, textures, buffers): Open3D and pymeshlab open them without looking, and
would wait for a pipe, or read whatever a stranger has chosen."""

import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote_to_bytes

from pagas_cl.errors import InputError
from pagas_cl.scene.files import opened, read_bytes
from pagas_cl.scene.readers.photos import inside

_MOST = 1 << 30         # bytes of such a file
_URI = re.compile(rb'"uri"\s*:\s*"(?!data:)([^"]*)"')
_NAMED = {".obj": re.compile(rb"^[ \t]*mtllib[ \t]+(.+)", re.MULTILINE), ".gltf": _URI, ".glb": _URI,
          ".ply": re.compile(rb"^comment TextureFile (.+)", re.MULTILINE)}
_TEXTURE = re.compile(rb"^[ \t]*(?:map_|bump|disp|refl|norm|decal)\S*[ \t]+(.+)", re.MULTILINE | re.IGNORECASE)


def check_parts(path: str | Path, *, outside: bool = True) -> None:
    """InputError where a file that the mesh file `path` names is a pipe, a device or the like, or too large to be what
    it should be; without `outside` also where its name leads out of the mesh's folder.

    What is not there is no error: who reads the mesh goes on without it.
    """
    path = Path(path)
    pattern = _NAMED.get(path.suffix.lower())
    if pattern is None or not path.is_file() or not path.stat().st_size:
        return
    with opened(path, 1 << 40) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        names = list(_named(pattern, content[:1 << 16] if path.suffix.lower() == ".ply" else content))
    for name in names:
        material = _read(path, name, outside)
        if path.suffix.lower() == ".obj":
            for texture in _named(_TEXTURE, material):
                _read(path, texture, outside)


def _named(pattern: re.Pattern[bytes], content: bytes | mmap.mmap) -> Iterator[str]:
    """All that a line's end may mean as names: options may stand before one, several of them on a line, or spaces in
    one."""
    for match in pattern.finditer(content):
        line = (unquote_to_bytes(match[1]) if pattern is _URI else match[1]).decode(errors="surrogateescape").strip()
        yield from [line[word.start():] for word in re.finditer(r"\S+", line)] + line.split()[:-1]


def _read(mesh: Path, name: str, outside: bool) -> bytes:
    """Content of the file `name` beside `mesh`; nothing where there is none."""
    what = f"mesh {str(mesh)!r}"
    try:
        if not (mesh.parent / name).exists() or (mesh.parent / name).is_dir():
            return b""
        return read_bytes(inside(mesh.parent, name, f"{what}: a file that it names", outside=outside), _MOST)
    except InputError as error:
        raise InputError(str(error) if "leads out" in str(error) else f"{what}: {error}") from error
    except (OSError, ValueError):
        return b""
