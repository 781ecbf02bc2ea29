"""Files that a mesh file names (materials, textures, buffers): a pipe would be waited for, and a foreign file must not
choose what is read on this machine."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from pagas_cl.errors import InputError
from pagas_cl.scene.untrusted import inside, read_bytes
from pagas_cl.system.files import is_file

_MOST = 1 << 30         # bytes of such a file
_MOST_FIELDS = 64       # of a line: options of a texture are 20 or fewer


@dataclass(frozen=True)
class Parts:
    """What the file `mesh` may read besides itself: regular files in its folder, or anywhere where `outside`."""

    mesh: Path
    outside: bool = True

    def check(self, line: str) -> list[tuple[str, Path]]:
        """Names and files that may be meant by `line`, the end of a line: options may stand before a name, several of
        them on a line, or spaces in one; the longest name first, and none that is not there.

        InputError where one of them is a pipe, a device or the like, too large to be what it should be, or leads out of
        the mesh's folder.
        """
        return [(name, path) for name in dict.fromkeys(_names(line)) for path in self._file(name)]

    def read_uri(self, uri: str) -> bytes:
        """Content of the file that a uri names; as `check`, and an InputError where there is none."""
        found = self.check(unquote(uri))
        if not found:
            raise InputError(f"mesh {str(self.mesh)!r} names the file {uri[:200]!r}, which is not there")
        return read_bytes(found[0][1], _MOST)

    def _file(self, name: str) -> Iterator[Path]:
        what = f"mesh {str(self.mesh)!r}"
        found = self.mesh.parent / name.replace("\\", "/")
        try:
            if not found.exists() or found.is_dir():
                return
        except (OSError, ValueError):      # no name that a file can have
            return
        path = inside(self.mesh.parent, name, f"{what}: a file that it names", outside=self.outside)
        try:
            read_bytes(path, _MOST)
        except InputError as error:
            raise InputError(f"{what}: {error}") from error
        if is_file(path):
            yield path


def _names(line: str) -> Iterator[str]:
    """Ends of a line that begin with a field, and its fields."""
    fields = line.split()[:_MOST_FIELDS]
    rest = line.strip()
    for word in fields:
        rest = rest[rest.index(word):]
        yield rest
        rest = rest[len(word):]
    yield from fields
