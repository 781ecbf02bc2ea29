"""Filter scripts (.mlx) that mix MeshLab's filters with our step.

The whole script is checked before anything runs, since pymeshlab would run what stands before a typo, and would take
defaults for values that it does not understand. Stretches of MeshLab's filters then go through pymeshlab, ours run
between them, and the history keeps every step, so that saving the script keeps ours.
"""

from __future__ import annotations

import logging
import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from pagas_cl.filters import native, parameters
from pagas_cl.filters.parameters import FILTER

from pagas_cl.errors import InputError, need
from pagas_cl.scene.readers.untrusted import read_xml, short, whole, word

log = logging.getLogger("pagas_cl")

_FILES = ("RichOpenFile", "RichSaveFile")
_FILE_NAMES = re.compile(r"file|path|text(ure)?_?name|newname", re.IGNORECASE)
_FILE_FILTERS = ("save_", "load_", "export_", "nxs_")
_MOST_STEPS = 10_000


@dataclass(frozen=True, eq=False)
class Step:
    """One step: MeshLab's (`request` is None) or ours; `number` counts from 1."""

    number: int
    name: str
    element: ElementTree.Element = field(repr=False)
    request: parameters.Request | None = None


def check_script(path, *, outside: bool = False) -> list[Step]:
    """Read a script and check all of it; nothing is run on any mesh of yours.

    Parameters
    ----------
    outside : bool
        Whether steps that read or write files of their own are allowed.

    Raises
    ------
    InputError
        No script, unknown filter (the nearest known one is named), unknown parameter, wrong type or value, a filter
        that would abort Python, or one that names files.
    """
    root = read_xml(Path(path), "FilterScript")
    elements = list(root)
    if not elements:
        raise InputError(f"{path} has no steps")
    if len(elements) > _MOST_STEPS:
        raise InputError(f"{path} has {len(elements)} steps, expected at most {_MOST_STEPS}")
    for number, element in enumerate(elements, 1):
        if element.tag == "xmlfilter":
            raise InputError(f"{path}: step {number} is an <xmlfilter>, which pymeshlab skips without a word: "
                             "remove it")
        if element.tag != "filter" or not element.get("name"):
            raise InputError(f"{path}: step {number} is {short(element.tag)}, expected <filter name=...>; "
                             "nothing was run")
    theirs = [e.get("name") for e in elements if e.get("name") != FILTER]
    for number, element in enumerate(elements, 1):
        python = native.python_name(element.get("name")) if theirs and not outside else None
        if python and python.startswith(_FILE_FILTERS):
            raise InputError(f"{path}: step {number} {element.get('name')!r} reads or writes files of its own; pass "
                             "outside=True (--outside) if you trust the script; nothing was run")
    known = native.look_up(theirs) if theirs else {}
    return [_checked(number, element, known, str(path), outside) for number, element in enumerate(elements, 1)]


def _checked(number: int, element, known: dict, path: str, outside: bool) -> Step:
    name = element.get("name")
    where = f"{path}: step {number} {name!r}"
    given = [dict(e.attrib) for e in element.iter("Param")]
    if len(given) != len(element):
        raise InputError(f"{where}: holds elements that are not <Param>; nothing was run")
    if name == FILTER:
        return Step(number, name, element, parameters.request(parameters.read_parameters(given, where), where))
    _check_native(known[name], name, given, where, outside)
    return Step(number, name, element)


def _check_native(known: native.Known, name: str, given: list[dict], where: str, outside: bool) -> None:
    if not known.exists:
        near = _nearest(name)
        raise InputError(f"{where} is neither ours nor pymeshlab's; did you mean {near!r}? nothing was run")
    if known.crash == "SIGABRT":
        raise InputError(f"{where} ends the whole Python process here ({known.crash}): MeshLab's filters that draw "
                         "need OpenGL, which this Python has not; nothing was run")
    if known.crash:
        log.warning("%s: trying it on a small sphere ended with %s; a crash inside pymeshlab cannot be caught", where,
                    known.crash)
    seen = set()
    for attributes in given:
        parameter = attributes.get("name", "")
        if parameter in seen:
            raise InputError(f"{where}: parameter {parameter!r} is there twice; nothing was run")
        seen.add(parameter)
        _check_parameter(known, parameter, attributes, where, outside)


def _check_parameter(known: native.Known, name: str, attributes: dict, where: str, outside: bool) -> None:
    kind = attributes.get("type", "")
    if known.types is not None:
        if name not in known.types:
            from difflib import get_close_matches

            near = get_close_matches(name, known.types, n=1, cutoff=0.0)
            raise InputError(f"{where}: unknown parameter {name!r}; " + (f"the nearest known one is {near[0]!r}" if near
                             else "it takes none") + "; nothing was run")
        if kind != known.types[name]:
            raise InputError(f"{where}: parameter {name!r} has type {kind!r}, expected {known.types[name]!r}; "
                             "nothing was run")
    value = attributes.get("value")
    if (kind in _FILES or _FILE_NAMES.search(name) and re.search(r"[\\/]|\.\.", value or "")) and not outside:
        raise InputError(f"{where}: parameter {name!r} names a file ({short(value)}); pass outside=True (--outside) if "
                         "you trust the script; nothing was run")
    _check_value(kind, name, attributes, (known.enums or {}).get(name), where)


def _check_value(kind: str, name: str, attributes: dict, choices: int | None, where: str) -> None:
    """pymeshlab takes the default for a value that it cannot read: refuse it here."""
    what, value = f"{where}: parameter {name!r}", attributes.get("value")
    if kind in ("RichInt", "RichFloat", "RichAbsPerc", "RichPercentage", "RichDynamicFloat", "RichEnum", "RichMesh"):
        if value is None:
            raise InputError(f"{what} has no value; nothing was run")
        number = word(value, what)
        if kind in ("RichInt", "RichEnum", "RichMesh"):
            whole(number, 0 if kind != "RichInt" else -2**31, 2**31 if choices is None else choices - 1, what)
        if kind == "RichInt" and not re.fullmatch(r"[+-]?\d+", value):
            raise InputError(f"{what} is {value!r}, expected a whole number; nothing was run")
    elif kind == "RichBool" and value not in ("true", "false"):
        raise InputError(f"{what} is {short(value)}, expected 'true' or 'false'; nothing was run")
    elif kind == "RichString" and value is None:
        raise InputError(f"{what} has no value; nothing was run")


def _nearest(name: str) -> str:
    from difflib import SequenceMatcher

    theirs = native.nearest(name)
    return max((FILTER, theirs), key=lambda near: SequenceMatcher(None, name.lower(), near.lower()).ratio())


def run_script(meshes, path, scene=None, *, outside: bool = False, device: str | None = None,
               progress=None) -> list[Step]:
    """Check a script, then run it on `meshes`.

    Parameters
    ----------
    meshes : pymeshlab.MeshSet
        Its current mesh is what the first step works on.
    path : path
        The script; `refine.mlx` beside this module is one.
    scene : folder, Scene, list of View, or (cameras, images)
        What our step refines with; may be left out where the script has no such step.
    device : str, optional
        Replaces the device that the script names.

    Notes
    -----
    A step that fails inside pymeshlab leaves the meshes as the steps before it made them; it is named in the error.
    """
    from pagas_cl.filters.pymeshlab_step import refine_layer, scene_views

    pymeshlab = need("pymeshlab", "meshlab", "running a filter script")
    steps = check_script(path, outside=outside)
    ours = [step for step in steps if step.request is not None]
    views = scene_views(scene) if ours else None
    if not meshes.mesh_number():
        raise InputError(f"{path}: the MeshSet has no mesh to start from; load one first")
    history = saved_history(meshes)
    try:
        for stretch in _stretches(steps):
            if stretch[0].request is None:
                _run_native(pymeshlab, meshes, stretch, path)
            else:
                refine_layer(meshes, views, stretch[0].request, device=device, progress=progress)
            history += [step.element for step in stretch]
    finally:
        restore_history(meshes, history)
    return steps


def _stretches(steps: list[Step]) -> list[list[Step]]:
    """Neighbouring steps of MeshLab's together, each of ours by itself."""
    stretches: list[list[Step]] = []
    for step in steps:
        if step.request is None and stretches and stretches[-1][0].request is None:
            stretches[-1].append(step)
        else:
            stretches.append([step])
    return stretches


def _run_native(pymeshlab, meshes, stretch: list[Step], path) -> None:
    """One stretch; on an error the steps are named that it could have been."""
    restore_history(meshes, [step.element for step in stretch])
    try:
        meshes.apply_filter_script()
    except (pymeshlab.PyMeshLabException, RuntimeError) as error:
        names = ", ".join(f"{step.number} {step.name!r}" for step in stretch)
        raise InputError(f"{path}: pymeshlab stopped in step {names}: {' '.join(str(error).split())[:300]}") from error


def saved_history(meshes) -> list[ElementTree.Element]:
    """The steps that a MeshSet has recorded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "history.mlx"
        meshes.save_filter_script(str(path))
        return list(ElementTree.parse(path).getroot()) if path.is_file() else []


def restore_history(meshes, elements: list[ElementTree.Element]) -> None:
    """Replace the steps that a MeshSet has recorded."""
    meshes.clear_filter_script()
    if not elements:
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "history.mlx"
        path.write_text(script_text(elements), encoding="utf-8")
        meshes.load_filter_script(str(path))


def script_text(elements: list[ElementTree.Element]) -> str:
    """A script of `elements`, as MeshLab writes one."""
    root = ElementTree.Element("FilterScript")
    root.extend(elements)
    ElementTree.indent(root, " ")
    return "<!DOCTYPE FilterScript>\n" + ElementTree.tostring(root, encoding="unicode") + "\n"
