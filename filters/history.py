"""The steps that a MeshSet has recorded: read, replaced, written as a script."""

import tempfile
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

from pagas_cl.errors import OutputError
from pagas_cl.filters.parameters import FILTER
from pagas_cl.scene.own_files import TEXT_MARK

CALL = "pagas_cl.filters.filter_script.run_script(meshes, script, scene), or on the command line: pagas-cl script"
NOTE = f"<!-- {FILTER!r} is a step of pagas_cl, which MeshLab and pymeshlab alone do not run: {CALL} -->"


def attribute_names(elements: Collection[ElementTree.Element]) -> set[str]:
    """Names that steps give to custom attributes."""
    return {param.get("value", "") for element in elements if "Attribute" in element.get("name", "")
            for param in element.iter("Param") if param.get("name") == "name"}


def saved_history(meshes) -> list[ElementTree.Element]:
    """The steps that a MeshSet has recorded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "history.mlx"
        meshes.save_filter_script(str(path))
        try:
            return list(ElementTree.parse(path).getroot()) if path.is_file() else []
        except ElementTree.ParseError as error:      # pymeshlab says nothing of a full disk
            raise OutputError(f"the history is cut off in the folder for temporary files ({folder!r}): make room, or "
                              "set TMPDIR to another place") from error


def restore_history(meshes, elements: Collection[ElementTree.Element]) -> None:
    """Replace the steps that a MeshSet has recorded."""
    meshes.clear_filter_script()
    if not elements:
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "history.mlx"
        path.write_text(_text(elements), encoding="utf-8")
        meshes.load_filter_script(str(path))


def history_text(meshes) -> str:
    """The steps that a MeshSet has recorded, as a script."""
    elements = saved_history(meshes)
    note = f"{NOTE}\n" if any(element.get("name") == FILTER for element in elements) else ""
    return _text(elements, f"<!-- {TEXT_MARK} -->\n{note}")


def _text(elements: Collection[ElementTree.Element], comments: str = "") -> str:
    root = ElementTree.Element("FilterScript")
    root.extend(elements)
    ElementTree.indent(root, " ")
    return f"<!DOCTYPE FilterScript>\n{comments}{ElementTree.tostring(root, encoding='unicode')}\n"
