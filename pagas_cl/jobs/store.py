"""Files whose final name never holds half of them; arrays under the hash of their content, found from any process."""

from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.npy_files import read_npy
from pagas_cl.system import files
from pagas_cl.system.files import digest_array, replaced

_KEPT = "finished views are kept, make room or choose another folder, and start the same command again"


@contextmanager
def written(path: Path, parts: Path | None = None, durable: bool = True):
    """Context of a binary file that gets the name `path` when all of it is on disk; see system.files.replaced."""
    with replaced(path, parts=parts, advice=_KEPT, durable=durable) as temporary, open(temporary, "wb") as file:
        yield file


def writing(path: Path) -> AbstractContextManager[None]:
    """As system.files.writing, with what becomes of the run."""
    return files.writing(path, _KEPT)


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


class Store:
    """A folder of arrays; made when the first one comes."""

    def __init__(self, folder: Path):
        self.folder = folder

    def put(self, array: np.ndarray) -> StoredArray:
        """Write `array` unless it is there already, whole."""
        digest = digest_array(array)
        stored = StoredArray(self.folder / f"{digest}.npy", digest)
        try:
            stored.load()
        except InputError:
            with written(stored.file) as file:
                np.save(file, np.ascontiguousarray(array))
        return stored

    def put_arrays(self, values) -> list:
        """Each array of `values` in the store; what is none (a file, None) as it is."""
        return [self.put(value) if isinstance(value, np.ndarray) else value for value in values]
