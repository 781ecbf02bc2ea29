"""Draw docs/architecture.svg from the code's own imports: rooms on floors, an arrow for an import, none going up.

    python docs/draw_architecture.py            # writes docs/architecture.svg
    python docs/draw_architecture.py --check    # status 1 where the picture, or the direction of an import, is wrong

Rooms are folders and the modules at the root; FLOORS says what may know what. Arrows that follow from others are left
out of the picture.
"""

from __future__ import annotations

import ast
import sys
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "architecture.svg"

# From the top floor down: a room imports from floors below its own alone. Name, one line for the picture.
FLOORS = [
    {"app.commands": "__main__, and a file a command", "": "public names, loaded when used"},
    {"filters": "MeshLab scripts, Open3D pipelines", "app": "the demo's scene, device check"},
    {"refine": "the method on one page", "app.tradeoffs": "error against time"},
    {"jobs": "many views, devices, resuming", "app.report": "pictures, pages", "app.evaluate": "errors"},
    {"method.view": "one view; rounds over many"},
    {"method.cameras": "cameras that are off"},
    {"method.effects": "what a scene needs"},
    {"method.surface": "mesh to depth, depth to mesh"},
    {"method.splat": "launches: a module a kernel file", "result": "of a view"},
    {"runtime": "devices, programs, memory", "scene": "cameras, photos, meshes, readers", "cl_kernels": "OpenCL C 1.2"},
    {"config": "frozen settings", "progress": "stages", "system": "files, locks, children"},
    {"errors": "one family, one sentence each"},
]
WIDTH, LEFT, WIDE, TALL, HIGH = 1180, 20, 270, 46, 74
COLORS = ["#dbe7f6", "#d8efe4", "#f7ecd2", "#f3dede", "#e7e0f3", "#e2e2e2"]
STYLE = ("<style>text { font-family: 'DejaVu Sans', Helvetica, Arial, sans-serif; fill: #222; text-anchor: middle; }"
         " .name { font-size: 14px; font-weight: bold; } .small { font-size: 12px; }"
         " .arrow { fill: none; stroke: #555; stroke-width: 1.2; }</style>")


def room_of(module: str) -> str:
    """The room of a module, both without "pagas_cl."."""
    parts = ["app", "commands"] if module == "__main__" else module.split(".")
    rooms = {room for floor in FLOORS for room in floor}
    return next((room for room in (".".join(parts[:2]), parts[0]) if room in rooms), module)


def modules() -> dict[str, Path]:
    """Every module of the package by its name without "pagas_cl."."""
    found = {}
    for folder, prefix in (("pagas_cl", ""), ("filters", "filters."), ("cl_kernels", "cl_kernels.")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = prefix + ".".join(path.relative_to(ROOT / folder).with_suffix("").parts)
            found[name.removesuffix("__init__").rstrip(".")] = path
    return found


def imported(path: Path, known) -> set[str]:
    """Modules of the package that a file imports, wherever the statement stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pagas_cl":
            module = node.module.removeprefix("pagas_cl").lstrip(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".lstrip(".")
                found.add(whole if whole in known else module)
    return found


def imports() -> dict[str, set[str]]:
    """Rooms that each room imports; ends with a sentence where an import does not go down."""
    height = {room: number for number, floor in enumerate(reversed(FLOORS)) for room in floor}
    edges: dict[str, set[str]] = {room: set() for room in height}
    found = modules()
    for name, path in found.items():
        for other in imported(path, found):
            own, used = room_of(name), room_of(other)
            if own not in height or used not in height:
                sys.exit(f"{path.relative_to(ROOT)}: {own} or {used} is on no floor of {Path(__file__).name}")
            if own != used and height[used] >= height[own]:
                sys.exit(f"{path.relative_to(ROOT)} imports {other}: imports go down, {own} lies no higher than {used}")
            edges[own].add(used)
    for room in ("method.splat", "method.surface", "method.cameras"):      # read as package data, by name
        edges[room].add("cl_kernels")
    return {room: used - {room} for room, used in edges.items()}


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without the arrows that a path of others already says."""
    def reach(room: str) -> set[str]:
        return {far for used in edges[room] for far in (used, *reach(used))}

    return {room: {one for one in used if not any(one in reach(other) for other in used - {one})}
            for room, used in edges.items()}


def picture(edges: dict[str, set[str]]) -> str:
    places, boxes = {}, []
    for number, floor in enumerate(FLOORS):
        for k, (room, line) in enumerate(floor.items()):
            middle = WIDTH * (k + 1) / (len(floor) + 1) if len(floor) < 4 else LEFT + WIDE / 2 + k * (WIDE + LEFT)
            x, y = middle - WIDE / 2, 16 + number * HIGH
            places[room] = middle, y
            boxes += [f'<rect x="{x:.0f}" y="{y}" width="{WIDE}" height="{TALL}" rx="7" '
                      f'fill="{COLORS[number % len(COLORS)]}" stroke="#555"/>',
                      f'<text x="{middle:.0f}" y="{y + 19}" class="name">{escape(room or "pagas_cl")}</text>',
                      f'<text x="{middle:.0f}" y="{y + 36}" class="small">{escape(line)}</text>']
    arrows = []
    for room, used in reduced(edges).items():
        for other in sorted(used):
            (x1, y1), (x2, y2) = places[room], places[other]
            y1, bend = y1 + TALL, (y2 - y1 - TALL) * 0.5
            arrows.append(f'<path d="M {x1:.0f} {y1} C {x1:.0f} {y1 + bend:.0f}, {x2:.0f} {y2 - bend:.0f}, {x2:.0f} '
                          f'{y2 - 3}" class="arrow" marker-end="url(#tip)"/>')
    height = 16 + len(FLOORS) * HIGH
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M 0 0 L 8 4 L 0 8 z" fill="#555"/></marker></defs>', STYLE,
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>', *arrows, *boxes, "</svg>"]) + "\n"


if __name__ == "__main__":
    drawn = picture(imports())
    if "--check" in sys.argv[1:]:
        if not PICTURE.is_file() or PICTURE.read_text(encoding="utf-8") != drawn:
            sys.exit(f"{PICTURE.relative_to(ROOT)} is not what the imports say: run python docs/draw_architecture.py")
    else:
        PICTURE.write_text(drawn, encoding="utf-8")
