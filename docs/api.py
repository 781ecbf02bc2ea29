"""Makes the API reference, HTML in build/api, from the docstrings: `make docs`.

A public name without a docstring ends it with status 1 and is named. Public are the modules below with what they list
in __all__ or what they define under a name without an underscore.
"""

import sys
from functools import cached_property
from pathlib import Path

import pdoc
from pdoc.doc import Class, Function, Module

import pagas_cl

MODULES = ["pagas_cl", "pagas_cl.config", "pagas_cl.config.presets", "pagas_cl.errors", "pagas_cl.app.evaluate",
           "pagas_cl.jobs",
           "pagas_cl.scene.readers.meshlab", "pagas_cl.filters.open3d_pipeline", "pagas_cl.filters.pymeshlab_step",
           "pagas_cl.filters.filter_script"]
PROPERTIES = (property, cached_property)
OUTPUT = Path(__file__).resolve().parent.parent / "build" / "api"


def undocumented(part: Module | Class) -> list[str]:
    """Full names of what `part` (a module or a class) makes public without a docstring, itself among them."""
    missing = [] if part.docstring else [part.fullname]
    for name, member in part.members.items():
        if name.startswith("_"):
            continue
        if isinstance(member, Class):
            missing += undocumented(member)
        elif member.docstring:
            continue
        elif isinstance(member, Function) or isinstance(vars(part.obj).get(name), PROPERTIES):
            missing.append(member.fullname)
    return missing


def main() -> int:
    for name in pagas_cl.__all__:  # pdoc reads what a module holds: have it hold what is loaded lazily
        getattr(pagas_cl, name)
    missing = [name for module in MODULES for name in undocumented(Module.from_name(module))]
    for name in sorted(set(missing)):
        print(f"{name} has no docstring", file=sys.stderr)
    pdoc.render.configure(docformat="numpy", show_source=False)
    pdoc.pdoc(*MODULES, output_directory=OUTPUT)
    print(f"{OUTPUT / 'index.html'}: {len(MODULES)} modules")
    return 1 if missing else 0


if __name__ == "__main__":
    raise SystemExit(main())
