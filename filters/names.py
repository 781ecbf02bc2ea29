"""Our step under its name beside MeshLab's own filters: pymeshlab's lists, its search, `apply_filter` and scripts.

pymeshlab keeps its filters in C++, where Python can add none. What it tells and takes by name are functions, which are
asked first here, and the originals for everything else.
"""

import functools
import inspect
import sys
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.filters.parameters import FILTER, PARAMETERS

METHOD = "apply_pagas_depth_refinement"
CALL = "pagas_cl.filters.filter_script.run_script(meshes, script, scene), or on the command line: pagas-cl script"
HINT = "run_with"     # a parameter that only says CALL: all that pymeshlab alone shows of a script are its parameters
NOTE = f"<!-- {FILTER!r} is a step of pagas_cl, which MeshLab and pymeshlab alone do not run: {CALL} -->"


def add_name(pymeshlab, kind, step) -> None:
    """Let the functions of `pymeshlab` and the methods of `kind` (a MeshSet) know `step` by its name."""
    for where, name, make in ((pymeshlab, "filter_list", _listed), (pymeshlab, "print_filter_list", _printed),
                              (pymeshlab, "print_filter_parameter_list", _described), (pymeshlab, "search", _found),
                              (kind, "apply_filter", _applied), (kind, "filter_parameter_values", _defaults),
                              (kind, "apply_filter_script", _guided), (kind, "save_filter_script", _explained)):
        known = getattr(where, name)
        if not hasattr(known, "of_pagas_cl"):
            wrapped = functools.wraps(known)(make(known, step))
            wrapped.of_pagas_cl = known
            setattr(where, name, wrapped)


def parameters_of(step) -> dict:
    """Name in Python -> default of each parameter of the step; `scene` has none."""
    given = inspect.signature(step).parameters.values()
    return {p.name: None if p.default is p.empty else p.default for p in given if p.name not in ("self", "progress")}


def _listed(known, step):
    return lambda: sorted([*known(), METHOD])


def _printed(known, step):
    def print_filter_list():
        known()
        _say(METHOD)

    return print_filter_list


def _described(known, step):
    def print_filter_parameter_list(name):
        if name != METHOD:
            return known(name)
        words = {p.python: p.description for p in PARAMETERS}
        _say(f"{METHOD} filter - list of parameter names:")
        for parameter, default in parameters_of(step).items():
            about = words.get(parameter, "Folder, Scene, views, or (cameras, images) to refine with; must be given")
            _say(f"\t{parameter} = {default!r}: {about}")
        return None

    return print_filter_parameter_list


def _found(known, step):
    def search(word):
        known(word)
        if word.lower() in f"{METHOD} {FILTER} photos depth refine".lower():
            _say(f"{METHOD}: pagas_cl, 'help(pymeshlab.MeshSet.{METHOD})'")

    return search


def _applied(known, step):
    def apply_filter(self, filter_name, **settings):
        return step(self, **settings) if filter_name == METHOD else known(self, filter_name, **settings)

    return apply_filter


def _defaults(known, step):
    return lambda self, filter_name: parameters_of(step) if filter_name == METHOD else known(self, filter_name)


def _guided(known, step):
    def apply_filter_script(self):
        from pagas_cl.filters.filter_script import saved_history

        if any(element.get("name") == FILTER for element in saved_history(self)):
            raise InputError(f"the script has the step {FILTER!r}, which needs a scene: run it with {CALL}")
        return known(self)

    return apply_filter_script


def _explained(known, step):
    def save_filter_script(self, file_name):
        known(self, file_name)
        path = Path(file_name)
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        if f'"{FILTER}"' in text and NOTE not in text:
            path.write_text(text.replace("<FilterScript>", f"{NOTE}\n<FilterScript>", 1), encoding="utf-8")

    return save_filter_script


def _say(text: str) -> None:
    sys.stdout.flush()
    sys.stdout.write(text + "\n")
