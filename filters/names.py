"""Our step under its name among MeshLab's own filters: pymeshlab's lists, its search, `apply_filter` and scripts.

pymeshlab keeps its filters in C++, where Python can add none. Its functions that list filters or take their names are
replaced by ones that handle our step, and pass everything else to the originals.
"""

import functools
import inspect
import sys
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.filters.history import CALL, NOTE, saved_history
from pagas_cl.filters.parameters import FILTER, PARAMETERS

METHOD = "apply_pagas_depth_refinement"
HINT = "run_with"     # a parameter that only says CALL: all that pymeshlab alone shows of a script are its parameters


def add_name(pymeshlab, kind, step) -> None:
    """Let the functions of `pymeshlab` and the methods of `kind` (a MeshSet) know `step` by its name."""
    for where, name, instead in (
            (pymeshlab, "filter_list", lambda known, step: sorted([*known(), METHOD])),
            (pymeshlab, "print_filter_list", _printed),
            (pymeshlab, "print_filter_parameter_list", _described), (pymeshlab, "search", _found),
            (kind, "apply_filter", _applied), (kind, "filter_parameter_values", _defaults),
            (kind, "apply_filter_script", _guided), (kind, "save_filter_script", _explained)):
        if not hasattr(getattr(where, name), "of_pagas_cl"):
            setattr(where, name, _replacement(instead, getattr(where, name), step))


def _replacement(instead, known, step):
    """The function `instead` of those below, which is given `known`, the original, and the step."""
    @functools.wraps(known)
    def wrapped(*given, **named):
        return instead(known, step, *given, **named)

    wrapped.of_pagas_cl = known
    return wrapped


def parameters_of(step) -> dict:
    """Name in Python -> default of each parameter of the step; `scene` has none."""
    given = inspect.signature(step).parameters.values()
    return {p.name: None if p.default is p.empty else p.default for p in given if p.name not in ("self", "progress")}


def _printed(known, step):
    known()
    _say(METHOD)


def _described(known, step, name):
    if name != METHOD:
        return known(name)
    descriptions = {p.python: p.description for p in PARAMETERS}
    _say(f"{METHOD} filter - list of parameter names:")
    for parameter, default in parameters_of(step).items():
        about = descriptions.get(parameter, "Folder, Scene, views, or (cameras, images) to refine with; must be given")
        _say(f"\t{parameter} = {default!r}: {about}")
    return None


def _found(known, step, word):
    known(word)
    if word.lower() in f"{METHOD} {FILTER} photos depth refine".lower():
        _say(f"{METHOD}: pagas_cl, 'help(pymeshlab.MeshSet.{METHOD})'")


def _applied(known, step, meshes, /, filter_name, **settings):
    return step(meshes, **settings) if filter_name == METHOD else known(meshes, filter_name, **settings)


def _defaults(known, step, meshes, filter_name):
    return parameters_of(step) if filter_name == METHOD else known(meshes, filter_name)


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


def _say(text: str) -> None:
    sys.stdout.flush()
    sys.stdout.write(text + "\n")
