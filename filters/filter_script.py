"""Filter scripts (.mlx) that mix MeshLab's filters with our step.

The whole script is checked before anything runs, since pymeshlab would run what stands before a typo, and would take
defaults for values that it does not understand. Stretches of MeshLab's filters then go through pymeshlab, the PAGaS
step runs between them, and the history keeps every step, so that saving the script keeps it.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from itertools import groupby
from xml.etree import ElementTree

from pagas_cl.errors import InputError, as_path, check_kind, log, need, short
from pagas_cl.filters import native, parameters
from pagas_cl.filters.history import HINT, attribute_names, restore_history, saved_history
from pagas_cl.filters.parameters import FILTER
from pagas_cl.filters.pymeshlab_step import refine_layer, scene_views
from pagas_cl.scene.untrusted import read_xml

_FILES = ("RichOpenFile", "RichSaveFile")
_FILE_NAMES = re.compile(r"file|path|text(ure)?_?name|newname", re.IGNORECASE)
_FILE_FILTERS = ("save_", "load_", "export_", "nxs_")
_MOST_STEPS = 10_000


@dataclass(frozen=True, eq=False)
class Step:
    """One step: MeshLab's (`request` is None) or the PAGaS step; `number` counts from 1."""

    number: int
    name: str
    element: ElementTree.Element = field(repr=False)
    request: parameters.Request | None = None


def check_script(path, *, outside: bool = False) -> list[Step]:
    """Read a script and check all of it; nothing is run on any mesh of yours.

    `outside` allows steps that read or write files of their own. InputError: no script, unknown filter (the nearest one
    is named) or parameter, wrong type or value, a filter that would abort Python, or one that names files.
    """
    elements = list(read_xml(as_path("path", path), "FilterScript"))
    try:
        if not elements:
            raise InputError(f"{path} has no steps")
        if len(elements) > _MOST_STEPS:
            raise InputError(f"{path} has {len(elements)} steps, expected at most {_MOST_STEPS}")
        wheres = [_place_of(element, f"{path}: step {number}", outside)
                  for number, element in enumerate(elements, 1)]
        theirs = [element.get("name") for element in elements if element.get("name") != FILTER]
        known = {FILTER: native.Known(True, parameters.TYPES), **(native.look_up(theirs) if theirs else {})}
        return [_checked_step(number, element, known[element.get("name")], where, outside)
                for number, (element, where) in enumerate(zip(elements, wheres), 1)]
    except InputError as error:
        raise InputError(f"{error}{'' if str(error).endswith('?') else ';'} nothing was run") from error


def _place_of(element, where: str, outside: bool) -> str:
    """The place of a step as messages name it; refuses what is no filter, and one that names files."""
    name = element.get("name")
    if element.tag == "xmlfilter":
        raise InputError(f"{where} is an <xmlfilter>, which pymeshlab skips without a word: remove it")
    if element.tag != "filter" or not name:
        raise InputError(f"{where} is {short(element.tag)}, expected <filter name=...>")
    if name != FILTER and not outside and (native.python_name(name) or "").startswith(_FILE_FILTERS):
        raise InputError(f"{where} {name!r} reads or writes files of its own; pass outside=True (--outside) if you "
                         "trust the script")
    return f"{where} {name!r}"


def _checked_step(number: int, element, known: native.Known, where: str, outside: bool) -> Step:
    name, given, values = element.get("name"), [dict(e.attrib) for e in element.iter("Param")], {}
    if name == FILTER:
        names = parameters.IN_SCRIPTS
        given = [{**attributes, "name": names.get(said := attributes.get("name", ""), said)} for attributes in given]
    if len(given) != len(element):
        raise InputError(f"{where}: holds elements that are not <Param>")
    given = [attributes for attributes in given if name != FILTER or attributes["name"] != HINT]
    _check_runs(known, name, where)
    for attributes in given:
        parameters.check_parameter(attributes, known.types, values, where)
        parameter, kind, value = (attributes.get(key, "") for key in ("name", "type", "value"))
        what = f"{where}: parameter {parameter!r}"
        names_file = kind in _FILES or _FILE_NAMES.search(parameter) and re.search(r"[\\/]|\.\.", value)
        if names_file and name != FILTER and not outside:
            raise InputError(f"{what} names a file ({short(value)}); pass outside=True (--outside) if you trust the "
                             "script")
        # pymeshlab takes the default for a value that it cannot read
        parameters.check_value(kind, attributes.get("value"), what, (known.enums or {}).get(parameter))
        values[parameter] = value
    return Step(number, name, element, parameters.request(values, where) if name == FILTER else None)


def _check_runs(known: native.Known, name: str, where: str) -> None:
    """Refuse a filter that pymeshlab has not, or that would end the process."""
    if not known.exists:
        names = {near.lower(): near for near in (FILTER, native.nearest(name))}
        near = get_close_matches(name.lower(), names, n=1, cutoff=0.5)
        raise InputError(f"{where} is neither a step of pagas_cl nor a filter of pymeshlab"
                         + (f"; did you mean {names[near[0]]!r}?" if near else ""))
    if known.crash and "SIGABRT" in known.crash:
        raise InputError(f"{where} ends the whole Python process here (SIGABRT): MeshLab's filters that draw "
                         "need OpenGL, which this Python has not")
    if known.crash:
        log.warning("%s: a process that tries it on a small sphere %s; a crash in pymeshlab cannot be caught", where,
                    known.crash)


def run_script(meshes, path, scene=None, *, outside: bool = False, device: str | None = None, progress=None,
               names: Collection[str] = ()) -> list[Step]:
    """Check a script, then run it on `meshes` (pymeshlab.MeshSet), from its current mesh on.

    `refine.mlx` next to this module is a script. `scene` is what our step refines with (folder, Scene, list of View, or
    (cameras, images)), where the script has such a step; `device` replaces the one that the script names. `names` are
    those of custom attributes that are not in small letters: pymeshlab lists none as it is spelled. A step that fails
    inside pymeshlab is named in the error, and leaves the meshes as those before it made them.
    """
    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    check_kind("meshes", meshes, (pymeshlab.MeshSet,), "a pymeshlab.MeshSet")
    check_kind("names", names, (list, tuple, set, frozenset), "a list of names of custom attributes")
    steps = check_script(path, outside=outside)
    refining = [step for step in steps if step.request is not None]
    views = scene_views(scene) if refining else None
    if not meshes.mesh_number():
        raise InputError(f"{path}: the MeshSet has no mesh to start from; load one first")
    history = saved_history(meshes)
    try:
        for _, neighbours in groupby(steps, lambda step: step.number if step.request else None):
            stretch = list(neighbours)    # MeshLab's steps together, each PAGaS step by itself
            if stretch[0].request is None:
                _run_native(pymeshlab, meshes, stretch, path)
            else:
                request = stretch[0].request
                refine_layer(meshes, views, replace(request, device=device or request.device), progress=progress,
                             spellings={*names} | attribute_names(history))
            history += [step.element for step in stretch]
    finally:
        restore_history(meshes, history)
    return steps


def _run_native(pymeshlab, meshes, stretch: list[Step], path) -> None:
    """One stretch; on an error the steps are named that it could have been."""
    restore_history(meshes, [step.element for step in stretch])
    try:
        meshes.apply_filter_script()
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        names = ", ".join(f"{step.number} {step.name!r}" for step in stretch)
        raise InputError(f"{path}: pymeshlab stopped in step {names}: {' '.join(str(error).split())[:300]}") from error
