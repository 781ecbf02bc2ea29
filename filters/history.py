"""The steps that a MeshSet has recorded: read, replaced, written as a script; and our step among them by its name."""

import functools
import tempfile
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

from pagas_cl.errors import InputError, OutputError
from pagas_cl.filters.parameters import FILTER
from pagas_cl.scene.own_files import TEXT_MARK

CALL = "pagas_cl.filters.filter_script.run_script(meshes, script, scene), or on the command line: pagas-cl script"
NOTE = f"<!-- {FILTER!r} is a step of pagas_cl, which MeshLab and pymeshlab alone do not run: {CALL} -->"
METHOD = "apply_pagas_depth_refinement"
HINT = "run_with"     # a parameter that only says CALL: all that pymeshlab alone shows of a script are its parameters


def attribute_names(elements: Collection[ElementTree.Element]) -> set[str]:
    """Names that steps give to custom attributes."""
    return {param.get("value", "") for element in elements if "Attribute" in element.get("name", "")
            for param in element.iter("Param") if param.get("name") == "name"}


def saved_history(meshes) -> list[ElementTree.Element]:
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


def add_name(kind, step) -> None:
    """Let methods of `kind` (a MeshSet) handle `step` by its name, and pass everything else to the originals (`known`):
    pymeshlab keeps its filters in C++, where Python can add none."""
    def apply_filter(meshes, known, /, filter_name, **settings):
        return step(meshes, **settings) if filter_name == METHOD else known(meshes, filter_name, **settings)

    def apply_filter_script(meshes, known):
        if any(element.get("name") == FILTER for element in saved_history(meshes)):
            raise InputError(f"the script has the step {FILTER!r}, which needs a scene: run it with {CALL}")
        return known(meshes)

    def save_filter_script(meshes, known, filter_script_name):
        known(meshes, filter_script_name)
        path = Path(filter_script_name)
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        if f'"{FILTER}"' in text and NOTE not in text:
            path.write_text(text.replace("<FilterScript>", f"{NOTE}\n<FilterScript>", 1), encoding="utf-8")

    for instead in (apply_filter, apply_filter_script, save_filter_script):
        known = getattr(kind, instead.__name__)
        if not hasattr(known, "__wrapped__"):       # once
            setattr(kind, instead.__name__, _replacement(instead, known))


def _replacement(instead, known):
    """A method that calls `instead(meshes, known, ...)`, with the help of `known`."""
    @functools.wraps(known)
    def method(meshes, *given, **named):
        return instead(meshes, known, *given, **named)

    return method
