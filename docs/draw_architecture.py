"""Draw docs/architecture.svg: the way of a view through the rooms, and who imports whom, from the real imports.

    python docs/draw_architecture.py            # writes docs/architecture.svg
    python docs/draw_architecture.py --check    # status 1 where the file is not what the imports say

An arrow goes from the room that imports to the room that is imported; arrows that follow from others are left out.
An import that climbs ends the script with the module that does it.
"""

from __future__ import annotations

import ast
import sys
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "architecture.svg"

# Rooms by level, from those that know most to those that know least: middle (pixels), name, what is in it, one line.
LEVELS = [
    [(360, "command line, filters", "__main__ commands filters", "typer, MeshLab scripts, Open3D"),
     (830, "studies", "tradeoffs costs bench demo selftest analysis expected remembered",
      "error against time, self-test, demo")],
    [(360, "refine",
      "refine one_view before_steps rounds cameras keep_mesh acceptance effects resemblance measurements",
      "the method on one page"),
     (830, "report, evaluate, synthetic", "report evaluate synthetic", "pictures, figures, test scenes")],
    [(200, "jobs", "jobs progress outlook", "many views, devices, resuming"),
     (1000, "result", "result", "DepthResult: what a view gives back")],
    [(200, "splat", "splat", "launches: a module a kernel file"),
     (640, "surface", "surface", "mesh depth and solve, TSDF")],
    [(140, "runtime", "runtime", "devices, programs"), (440, "cl_kernels", "cl_kernels", "OpenCL C 1.2"),
     (760, "reference", "reference", "float64 twins")],
    [(705, "scene", "scene", "cameras, photos, meshes, readers: host side, NumPy")],
    [(595, "config, errors", "config stage presets errors child", "frozen settings, one family of errors")],
]
WIDE = {"scene": 890, "config, errors": 1110}      # what nearly all others import lies below them all
STEPS = [
    [("photos, cameras,", "mesh or depth"), ("scene", "camera, view, readers"), ("surface.raster", "mesh → depth"),
     ("measurements,", "effects: what is on"), ("splat.level", "Adam steps, level by level")],
    [("mesh", "or depth maps"), ("surface.fuse", "TSDF → mesh"), ("surface.agree", "what others confirm"),
     ("acceptance", "held-out views judge"), ("splat.evidence", "which depths photos confirm")],
]
KERNELS = ("one step of splat.level, for each context view: project → composite → ssim, loss → backward;",
           "then gradient_filter → smooth → step (Adam)")
WIDTH, HEIGHT = 1180, 1010
COLORS = ["#dbe7f6", "#d8efe4", "#f7ecd2", "#f3dede", "#e7e0f3", "#e2e2e2", "#f2f2f2"]


def room_of() -> dict[str, str]:
    """Room of each folder or module at the top of the package."""
    return {part: name for level in LEVELS for _, name, parts, _ in level for part in parts.split()}


def imports() -> dict[str, set[str]]:
    """Rooms that each room imports, itself left out."""
    rooms, found = room_of(), {name: set() for level in LEVELS for _, name, *_ in level}
    for folder in ("pagas_cl", "filters"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            own = "filters" if folder == "filters" else path.relative_to(ROOT / folder).parts[0].removesuffix(".py")
            for name in _imported(ast.parse(path.read_text(encoding="utf-8"))):
                if own == "__init__" or name.startswith("_"):
                    continue
                for part in (own, name):
                    if part not in rooms:
                        sys.exit(f"{path.relative_to(ROOT)}: {part!r} belongs to no room, name one in {__file__}")
                found[rooms[own]].add(rooms[name])
    found["splat"].add("cl_kernels")          # read as package data, by the names that launchers give
    found["surface"].add("cl_kernels")
    for name, used in found.items():
        used.discard(name)
    return found


def _imported(tree) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("pagas_cl.")}


def check_one_way(edges: dict[str, set[str]]) -> None:
    """End where a room imports one that stands above it."""
    level_of = {name: k for k, level in enumerate(LEVELS) for _, name, *_ in level}
    for name, used in edges.items():
        for other in used:
            if level_of[other] < level_of[name]:
                sys.exit(f"{name} imports {other}, which stands above it: imports go one way")


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without the arrows that a path of others already says."""
    def reach(name, seen):
        for other in edges[name] - seen:
            seen.add(other)
            reach(other, seen)
        return seen

    return {name: {o for o in used if not any(o in reach(p, set()) for p in used if p != o)}
            for name, used in edges.items()}


def box(x, y, w, h, color, title, text="") -> str:
    lines = [f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="8" fill="{color}" stroke="#555"/>',
             f'<text x="{x + w / 2}" y="{y + 23}" class="name">{escape(title)}</text>']
    if text:
        lines.append(f'<text x="{x + w / 2}" y="{y + 42}" class="small">{escape(text)}</text>')
    return "\n".join(lines)


def arrow(x1, y1, x2, y2) -> str:
    bend = (y2 - y1) * 0.45
    way = f"M {x1} {y1} C {x1} {y1 + bend}, {x2} {y2 - bend}, {x2} {y2}" if y2 != y1 else f"M {x1} {y1} L {x2} {y2}"
    return f'<path d="{way}" class="arrow" marker-end="url(#tip)"/>'


def flow() -> list[str]:
    """The way of a view: there in the first row, back in the second."""
    parts, w, h, gap, left = [], 196, 56, 38, 24
    for row, steps in enumerate(STEPS):
        y = 66 + row * 100
        for k, (title, text) in enumerate(steps):
            x = left + k * (w + gap)
            parts.append(box(x, y, w, h, "#fff" if k == 0 else "#eef4fb", title, text))
            if k:
                ends = (x - gap + 2, x - 4) if row == 0 else (x - 2, x - gap + 4)
                parts.append(arrow(ends[0], y + h / 2, ends[1], y + h / 2))
    x = left + 4 * (w + gap) + w / 2
    parts.append(arrow(x, 66 + h + 2, x, 162))
    parts += [f'<text x="{left}" y="{252 + 18 * k}" class="left">{escape(line)}</text>'
              for k, line in enumerate(KERNELS)]
    return parts


def rooms(edges: dict[str, set[str]]) -> list[str]:
    """Boxes by level, arrows between them."""
    h, places, parts = 56, {}, []
    for k, level in enumerate(LEVELS):
        for middle, name, *_ in level:
            w = WIDE.get(name, 300 if len(level) < 3 else 200)
            places[name] = (middle - w / 2, 336 + k * 95, w)

    def middle_of(name):
        return places[name][0] + places[name][2] / 2

    def shared(name, others, other):
        """Where the arrow of `other` touches the edge of `name`, which it shares with those of `others`."""
        x, _, w = places[name]
        return x + w * (sorted(others, key=middle_of).index(other) + 1) / (len(others) + 1)

    def below(name):
        return [other for other in edges[name] if places[other][1] > places[name][1]]

    for name, used in edges.items():
        x, y, w = places[name]
        for other in sorted(used):
            x2, y2, w2 = places[other]
            if y2 == y:
                ends = (x + w + 2, x2 - 4) if x2 > x else (x - 2, x2 + w2 + 4)
                parts.append(arrow(ends[0], y + h / 2, ends[1], y + h / 2))
            else:
                start, users = shared(name, below(name), other), [user for user in edges if other in below(user)]
                end = max(start, x2 + 15) if other in WIDE else shared(other, users, name)
                parts.append(arrow(start, y + h + 2, end, y2 - 4))
    for k, level in enumerate(LEVELS):
        for _, name, _, text in level:
            x, y, w = places[name]
            parts.append(box(x, y, w, h, COLORS[k], name, text))
    return parts


def picture() -> str:
    edges = imports()
    check_one_way(edges)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M 0 0 L 8 4 L 0 8 z" fill="#444"/></marker></defs>',
        "<style>text { font-family: 'DejaVu Sans', Helvetica, Arial, sans-serif; fill: #222; }"
        " .name { font-size: 15px; font-weight: bold; text-anchor: middle; }"
        " .small { font-size: 12.5px; text-anchor: middle; } .left { font-size: 13px; }"
        " .head { font-size: 17px; font-weight: bold; }"
        " .arrow { fill: none; stroke: #444; stroke-width: 1.5; }</style>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        '<text x="24" y="38" class="head">The way of a view</text>', *flow(),
        '<text x="24" y="312" class="head">Rooms: an arrow is an import, and none goes up</text>',
        *rooms(reduced(edges)), "</svg>"]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    drawn = picture()
    if "--check" in sys.argv[1:]:
        if not PICTURE.is_file() or PICTURE.read_text(encoding="utf-8") != drawn:
            sys.exit(f"{PICTURE.relative_to(ROOT)} is not what the imports say: run python docs/draw_architecture.py")
    else:
        PICTURE.write_text(drawn, encoding="utf-8")
