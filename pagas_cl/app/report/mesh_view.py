"""A viewer that turns a mesh before and after in the browser: HTML that needs no network and no other file."""

import base64
import json
import zlib
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from pagas_cl.app.report.moved import moved_by
from pagas_cl.app.report.page import html_page, slider
from pagas_cl.app.report.pictures import MAPS, css_gradient
from pagas_cl.app.report.simplify import simplify
from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import vertex_normals
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.system.files import write_text

MOST_TRIANGLES = 200_000   # of each mesh in a page: some 2.5 MB
SCRIPTS = ["viewer.js"]
_NOTHING = 255             # of a value that is stored in 8 bits


@dataclass(frozen=True, eq=False)
class VertexValues:
    """Something to colour the mesh after by: `values` (V,), one a vertex, NaN = unknown.

    `unit` stands behind the numbers of the scale. "signed": white at zero, as far to both sides; "sequential": from the
    least to the most. `low` and `high` are the ends of the scale; by default all but 2 % of the values lie in it.
    """

    title: str
    values: np.ndarray = field(repr=False)
    unit: str = ""
    map_name: str = "sequential"
    low: float | None = None
    high: float | None = None

    def scale(self) -> tuple[float, float]:
        """The ends of the scale."""
        known = np.asarray(self.values, np.float64)
        known = known[np.isfinite(known)]
        low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
        if self.map_name == "signed":
            high = max(abs(low), abs(high))
            low = -high
        low, high = (float(given if given is not None else found)
                     for given, found in ((self.low, low), (self.high, high)))
        return low, max(high, low + 1e-9 * max(abs(low), 1e-9))


def mesh_viewer(before, after, values=(), *, camera: Camera | None = None, most: int = MOST_TRIANGLES) -> str:
    """HTML of the viewer; `SCRIPTS` have to run on its page.

    Parameters
    ----------
    before, after : Surface, (vertices, faces), or whatever refine_mesh takes
        `before` may be None.
    values : sequence of VertexValues
        Of the mesh after; "moved", the distance from the mesh before, comes by itself.
    camera : Camera, optional
        From where the meshes are seen at first; else from the side to which most of the mesh after looks.
    most : int
        Triangles of each mesh; one with more is simplified, and the page says so.

    Raises
    ------
    InputError
    """
    meshes = [to_surface(mesh) for mesh in (before, after) if mesh is not None]
    fewer = [simplify(mesh.vertices, mesh.faces, most) for mesh in meshes]
    vertices, faces, owner = fewer[-1]
    shown = []
    for value in values:
        if np.shape(value.values) != (len(meshes[-1].vertices),):
            raise InputError(f"values {value.title!r} have shape {np.shape(value.values)}, expected "
                             f"({len(meshes[-1].vertices)},), one a vertex of the mesh after")
        shown.append((value, value.scale(), _mean_of(np.asarray(value.values, np.float64), owner, len(vertices))))
    if before is not None:
        moved = moved_by(vertices, meshes[0].vertices, meshes[0].faces)
        value = VertexValues("moved", moved, "scene units along the surface's normal", "signed")
        shown.insert(0, (value, value.scale(), moved))
    blob, content = bytearray(), {"meshes": [], "values": []}
    corner, size = _box([v for v, _, _ in fewer])
    for name, mesh, (v, f, _) in zip(("before", "after")[-len(meshes):], meshes, fewer):
        content["meshes"].append({"name": name, "vertices": len(v), "faces": len(f), "of": len(mesh.faces)})
        blob += np.rint((v - corner) / size * 65535).astype(np.uint16).tobytes()
        normals = vertex_normals(v, f)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        blob += np.rint(normals * 127).astype(np.int8).tobytes()
        blob += f.astype(np.uint32).tobytes()
    for value, (low, high), at in shown:
        share = np.rint(np.clip((at - low) / (high - low), 0, 1) * (_NOTHING - 1))
        blob += np.where(np.isfinite(at), share, _NOTHING).astype(np.uint8).tobytes()
        content["values"].append({"title": value.title, "colors": MAPS[value.map_name]})
    content |= {"size": size.tolist(), **_first_sight(vertices, faces, corner, camera),
             "blob": base64.b64encode(zlib.compress(bytes(blob))).decode()}
    return _fragment(content, [(value, scale, not np.isfinite(at).all()) for value, scale, at in shown])


def write_mesh_page(path, before, after, values=(), *, title: str = "pagas_cl", camera: Camera | None = None,
                    most: int = MOST_TRIANGLES) -> Path:
    """Write one HTML file that turns two meshes in a browser (arguments as in `mesh_viewer`); returns its path."""
    viewer = mesh_viewer(before, after, values, camera=camera, most=most)
    return write_text(path, html_page(title, [], [], [], body=viewer, scripts=SCRIPTS))


def _fragment(content: dict, values) -> str:
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    buttons = "".join(f'<button type="button" aria-pressed="{str(k < 0).lower()}" data-value="{k}">{escape(title)}'
                      "</button>" for k, title in enumerate(["shaded", *(v.title for v, *_ in values)], -1))
    scales = "".join(
        f'<div class="scale" hidden><span>{low:.3g}</span><div class="strip" style="background:'
        f'{css_gradient(value.map_name)}"></div><span>{high:.3g} {escape(value.unit)}'
        f'{"; grey: unknown" * unknown}</span></div>'
        for value, (low, high), unknown in values)
    both = slider("share of the picture that shows the mesh before") if len(content["meshes"]) == 2 else ""
    sizes = "; ".join(f"{mesh['name']}: {mesh['of']:,} triangles"
                      + (f", {mesh['faces']:,} of them after simplifying are shown" if mesh["faces"] < mesh["of"]
                         else "") for mesh in content["meshes"])
    return (f'<div class="viewer"><div class="stage"><canvas tabindex="0" aria-label="the mesh; drag to turn it">'
            f'</canvas><p class="loading">loading the mesh</p>{both}</div><div class="choice">{buttons}'
            f'<label><input type="checkbox"> facets</label>{scales}</div>'
            f'<p class="legend">{escape(sizes)}. Drag: turn; wheel (after a click) or two fingers: zoom; right button '
            "or two fingers: move; double click: back to the first view."
            f'</p><script type="application/json">{data}</script></div>')


def _mean_of(values, owner, count: int) -> np.ndarray:
    """Mean of the known values of each cell, NaN where there is none."""
    known = np.isfinite(values) & (owner >= 0)
    number = np.bincount(owner[known], minlength=count)
    total = np.bincount(owner[known], values[known], count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _box(clouds) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.min([v.min(axis=0) for v in clouds], axis=0), np.max([v.max(axis=0) for v in clouds], axis=0)
    return low, np.maximum(high - low, 1e-12 * max((high - low).max(), 1e-300))


def _first_sight(vertices, faces, corner, camera) -> dict:
    """The rows of the first view's rotation (x right, y down, z away); in it, the middle of the mesh (in the mesh's own
    axes), half its size along each axis, and the radius: of all of it but for a few vertices that lie far off."""
    if camera is not None:
        rotation = camera.world_to_camera[:3, :3]
    else:
        away = -vertex_normals(vertices, faces).sum(axis=0)
        away = away / np.linalg.norm(away) if np.linalg.norm(away) > 0 else np.array([0.0, 0, 1])
        down = np.array([0.0, -1, 0]) if abs(away[1]) < 0.9 else np.array([0.0, 0, -1])
        right = np.cross(down, away)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(away, right), away])
    least, low, high, most = np.percentile((vertices - corner) @ rotation.T, (0, 1, 99, 100), axis=0)
    low, high = np.maximum(least, low - (high - low) / 2), np.minimum(most, high + (high - low) / 2)
    return {"middle": ((low + high) / 2 @ rotation).tolist(), "half": ((high - low) / 2).tolist(),
            "radius": float(np.linalg.norm(high - low) / 2) or 1.0, "rotation": np.asarray(rotation).tolist()}
