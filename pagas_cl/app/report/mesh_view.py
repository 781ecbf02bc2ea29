"""A viewer that turns a mesh before and after in the browser: HTML that needs no network and no other file."""

import base64
import json
import zlib
from html import escape
from pathlib import Path

import numpy as np

from pagas_cl.app.report.mesh_shape import moved_by, simplify
from pagas_cl.app.report.page import html_page, slider
from pagas_cl.app.report.pictures import MAPS, css_gradient
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import vertex_normals
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.system.files import write_text

MOST_TRIANGLES = 200_000   # of each mesh in a page: some 2.5 MB
SCRIPTS = ["viewer.js"]
_NOTHING = 255             # of a value that is stored in 8 bits


def mesh_viewer(before, after, *, camera: Camera | None = None, most: int = MOST_TRIANGLES) -> str:
    """HTML of the viewer; `SCRIPTS` have to run on its page. The mesh after is also shown in colours of how far it lies
    from the one before: white where it has not moved.

    Parameters
    ----------
    before, after : Surface, (vertices, faces), or whatever refine_mesh takes
        `before` may be None.
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
    vertices, faces = fewer[-1]
    blob, content = bytearray(), {"meshes": [], "values": []}
    corner = np.min([v.min(axis=0) for v, _ in fewer], axis=0)
    size = np.max([v.max(axis=0) for v, _ in fewer], axis=0) - corner
    size = np.maximum(size, 1e-12 * max(size.max(), 1e-300))
    for name, mesh, (v, f) in zip(("before", "after")[-len(meshes):], meshes, fewer):
        content["meshes"].append({"name": name, "vertices": len(v), "faces": len(f), "of": len(mesh.faces)})
        blob += np.rint((v - corner) / size * 65535).astype(np.uint16).tobytes()
        normals = vertex_normals(v, f)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        blob += np.rint(normals * 127).astype(np.int8).tobytes()
        blob += f.astype(np.uint32).tobytes()
    scale = ""
    if before is not None:
        moved = moved_by(vertices, meshes[0].vertices, meshes[0].faces)
        known = np.isfinite(moved)
        most_moved = max(float(np.percentile(np.abs(moved[known]), 98)) if known.any() else 1.0, 1e-300)
        share = np.rint((np.clip(moved / most_moved, -1, 1) + 1) / 2 * (_NOTHING - 1))
        blob += np.where(known, share, _NOTHING).astype(np.uint8).tobytes()
        content["values"].append({"title": "moved", "colors": MAPS["signed"]})
        strip = f'<div class="strip" style="background:{css_gradient("signed")}"></div>'
        scale = (f'<div class="scale" hidden><span>{-most_moved:.3g}</span>{strip}<span>{most_moved:.3g} scene units '
                 f"along the surface's normal{'; grey: unknown' * (not known.all())}</span></div>")
    content |= {"size": size.tolist(), **_first_sight(vertices, faces, corner, camera),
             "blob": base64.b64encode(zlib.compress(bytes(blob))).decode()}
    return _fragment(content, scale)


def write_mesh_page(path, before, after, *, title: str = "pagas_cl", camera: Camera | None = None,
                    most: int = MOST_TRIANGLES) -> Path:
    """Write one HTML file that turns two meshes in a browser (arguments as in `mesh_viewer`); returns its path."""
    viewer = mesh_viewer(before, after, camera=camera, most=most)
    return write_text(path, html_page(title, [], [], [], body=viewer, scripts=SCRIPTS))


def _fragment(content: dict, scale: str) -> str:
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    titles = ["shaded", *(value["title"] for value in content["values"])]
    buttons = "".join(f'<button type="button" aria-pressed="{str(k < 0).lower()}" data-value="{k}">{escape(title)}'
                      "</button>" for k, title in enumerate(titles, -1))
    both = slider("share of the picture that shows the mesh before") if len(content["meshes"]) == 2 else ""
    sizes = "; ".join(f"{mesh['name']}: {mesh['of']:,} triangles"
                      + (f", {mesh['faces']:,} of them after simplifying are shown" if mesh["faces"] < mesh["of"]
                         else "") for mesh in content["meshes"])
    return (f'<div class="viewer"><div class="stage"><canvas tabindex="0" aria-label="the mesh; drag to turn it">'
            f'</canvas><p class="loading">loading the mesh</p>{both}</div><div class="choice">{buttons}'
            f'<label><input type="checkbox"> facets</label>{scale}</div>'
            f'<p class="legend">{escape(sizes)}. Drag: turn; wheel (after a click) or two fingers: zoom; right button '
            "or two fingers: move; double click: back to the first view."
            f'</p><script type="application/json">{data}</script></div>')


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
