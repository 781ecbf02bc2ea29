"""Materials of .obj files: read from their libraries (.mtl), and written with the mesh, each with its statements and
the same images."""

import shutil
from pathlib import Path
from typing import TextIO

import numpy as np

from pagas_cl.scene.mesh import Material, Surface
from pagas_cl.scene.meshes.content import MARK, text_of_line
from pagas_cl.scene.meshes.parts import Parts
from pagas_cl.system.files import read_bytes

_IMAGES = ("map_", "bump", "disp", "refl", "norm", "decal")      # statements that end in a file's name begin so


def read_materials(libraries: list[str], names: list[str], parts: Parts) -> tuple[Material, ...]:
    """The materials `names`, in their order, as the files `libraries` describe them; without statements where none
    does."""
    found: dict[str, list[tuple[str, Path | None]]] = {}
    for line in libraries:
        for _, path in parts.check(line):
            _read_library(path, parts, found)
    return tuple(Material(name, tuple(found.get(name, ()))) for name in dict.fromkeys(names))


def _read_library(path: Path, parts: Parts, found: dict[str, list[tuple[str, Path | None]]]) -> None:
    """Add the statements of each material to `found`; those that name an image without the name, and with its path."""
    statements: list[tuple[str, Path | None]] = []
    for line in read_bytes(path, 1 << 30).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        text = text_of_line(line).replace("\t", " ").strip()
        word, _, rest = text.partition(" ")
        if word.lower() == "newmtl":
            statements = found.setdefault(rest.strip(), [])
        elif word.lower().startswith(_IMAGES):
            images = [(name, image) for name, image in parts.check(rest) if text.endswith(name)]
            for name, image in images[:1]:
                statements.append((text.removesuffix(name).strip(), image))
            if not images:
                statements.append((text, None))
        elif text and not text.startswith("#"):
            statements.append((text, None))


def write_obj(path: Path, surface: Surface) -> None:
    """All digits of coordinates; materials next to it in a .mtl file, their images under names that begin like its
    own."""
    texture = surface.texture
    with open(path, "w", encoding="utf-8", errors="surrogateescape") as file:
        file.write(f"# {MARK}\n")
        if texture is not None and any(material.name for material in texture.library):
            _write_library(path.with_suffix(".mtl"), texture.library)
            file.write(f"mtllib {path.stem}.mtl\n")
        rows = surface.vertices.tolist()
        if surface.colors is not None:
            rows = [a + b for a, b in zip(rows, surface.colors.tolist(), strict=True)]
        file.writelines(f"v {' '.join(map(repr, row))}\n" for row in rows)
        if surface.normals is not None:
            file.writelines(f"vn {x!r} {y!r} {z!r}\n" for x, y, z in surface.normals.tolist())
        numbers = np.zeros((len(surface.faces), 3), np.int64)
        if texture is not None and texture.coordinates is not None:
            given = np.isfinite(texture.coordinates).all(axis=(1, 2))
            rows_of, place = np.unique(texture.coordinates[given].reshape(-1, 2), axis=0, return_inverse=True)
            numbers[given] = place.reshape(-1, 3) + 1
            file.writelines(f"vt {u!r} {v!r}\n" for u, v in rows_of.tolist())
        _write_faces(file, surface, numbers)


def _write_faces(file: TextIO, surface: Surface, numbers: np.ndarray) -> None:
    """`numbers` (F, 3) are those of texture coordinates, 0 where there are none."""
    texture, used = surface.texture, -1
    materials = [0] * len(numbers) if texture is None else texture.materials.tolist()
    normal = surface.normals is not None
    for corners, places, material in zip((surface.faces + 1).tolist(), numbers.tolist(), materials, strict=True):
        if texture is not None and material != used:
            used = material
            if len(texture.library) > 1 or texture.library[used].name:
                file.write(f"usemtl {texture.library[used].name or 'none'}\n")
        references = [f"{corner}/{place or ''}/{corner}" if normal else f"{corner}/{place}" if place else str(corner)
                 for corner, place in zip(corners, places, strict=True)]
        file.write(f"f {' '.join(references)}\n")


def _write_library(path: Path, library: tuple[Material, ...]) -> None:
    names: dict[Path, str] = {}
    with open(path, "w", encoding="utf-8", errors="surrogateescape") as file:
        file.write(f"# {MARK}\n")
        for material in library:
            file.write(f"newmtl {material.name}\n")
            for text, image in material.statements:
                if image is None:
                    file.write(f"{text}\n")
                    continue
                if image not in names:
                    names[image] = f"{path.stem}_{len(names)}{image.suffix}"
                    shutil.copyfile(image, path.with_name(names[image]))
                file.write(f"{text} {names[image]}\n")
