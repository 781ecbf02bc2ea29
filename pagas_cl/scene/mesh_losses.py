"""What a mesh file holds that would be lost on the way through Open3D to another file: asked before the work.

The tables are what scene.mesh_attributes and scene.mesh_file carry along; who teaches them more adds it here.
"""

from pathlib import Path

from pagas_cl.scene.files import opened
from pagas_cl.scene.ply import CORNERS, HEADER, header_of, keeps_numbers

_KEPT = {"vertex": {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"},
         "face": {*CORNERS}}
_MANY = {b"usemtl": "materials", b"g": "groups", b"o": "objects"}      # one of each is a name, several are parts


def losses(mesh: str | Path, output: str | Path) -> list[str]:
    """In words, what the .ply or .obj file `mesh` has and `output` would not have; of other kinds nothing is known."""
    mesh, kind = Path(mesh), Path(output).suffix.lower()
    if mesh.suffix.lower() == ".ply":
        lost, has = _of_ply(mesh, kind == ".ply" and keeps_numbers(mesh))
    elif mesh.suffix.lower() == ".obj":
        lost, has = _of_obj(mesh)
    else:
        return []
    if "texture coordinates" in has and kind != ".obj":
        lost.append("texture coordinates")
    if "vertex colours" in has and kind == ".stl":
        lost.append("vertex colours")
    return lost


def _of_ply(path: Path, numbers: bool) -> tuple[list[str], set[str]]:
    """What is lost in any case, and what is there for kinds of files that have it; all `numbers` of vertices may be
    kept."""
    lost, has = [], set()
    with opened(path, 1 << 40) as file:
        _, elements, _ = header_of(file.read(HEADER))
    for element, count, properties in elements:
        if element not in _KEPT:
            lost += [f"elements {element!r}"] * bool(count)
            continue
        names = [words[-1] for words in properties if words]
        if not (numbers and element == "vertex"):
            lost += [f"{element} property {name!r}" for name in names if name not in _KEPT[element]]
        if element == "vertex" and "red" in names:
            has.add("vertex colours")
    return lost, has


def _of_obj(path: Path) -> tuple[list[str], set[str]]:
    found: dict[bytes, set[bytes]] = {word: set() for word in _MANY}
    has = set()
    with opened(path, 1 << 40) as file:
        for line in file:
            word, _, rest = line.strip().partition(b" ")
            if word in found:
                found[word].add(rest)
            elif word == b"vt":
                has.add("texture coordinates")
            elif word == b"v" and len(rest.split()) >= 6:
                has.add("vertex colours")
    return [f"{len(names)} {_MANY[word]}" for word, names in found.items() if len(names) > 1], has
