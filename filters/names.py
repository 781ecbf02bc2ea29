"""Our step under its name where pymeshlab applies and saves filters: `apply_filter`, and filter scripts.

pymeshlab keeps its filters in C++, where Python can add none. Methods of its MeshSet that take a filter's name are
replaced by ones that handle our step, and pass everything else to the originals.
"""

import functools
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.filters.history import CALL, NOTE, saved_history
from pagas_cl.filters.parameters import FILTER

METHOD = "apply_pagas_depth_refinement"
HINT = "run_with"     # a parameter that only says CALL: all that pymeshlab alone shows of a script are its parameters


def add_name(kind, step) -> None:
    """Let the methods of `kind` (a MeshSet) know `step` by its name."""
    for name, instead in (("apply_filter", _applied), ("apply_filter_script", _guided),
                          ("save_filter_script", _explained)):
        if not hasattr(getattr(kind, name), "of_pagas_cl"):
            setattr(kind, name, _replacement(instead, getattr(kind, name), step))


def _replacement(instead, known, step):
    """The function `instead` of those below, which is given `known`, the original, and the step."""
    @functools.wraps(known)
    def wrapped(*given, **named):
        return instead(known, step, *given, **named)

    wrapped.of_pagas_cl = known
    return wrapped


def _applied(known, step, meshes, /, filter_name, **settings):
    return step(meshes, **settings) if filter_name == METHOD else known(meshes, filter_name, **settings)


def _guided(known, step, meshes):
    if any(element.get("name") == FILTER for element in saved_history(meshes)):
        raise InputError(f"the script has the step {FILTER!r}, which needs a scene: run it with {CALL}")
    return known(meshes)


def _explained(known, step, meshes, file_name):
    known(meshes, file_name)
    path = Path(file_name)
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if f'"{FILTER}"' in text and NOTE not in text:
        path.write_text(text.replace("<FilterScript>", f"{NOTE}\n<FilterScript>", 1), encoding="utf-8")
