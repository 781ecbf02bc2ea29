"""A viewer that turns a mesh before and after in the browser: HTML that needs no network and no other file; by NumPy.

Of a mesh with too many triangles the vertices of each cell of a grid become one, placed where the planes of its
triangles meet best (quadric clustering), so that creases stay. Distances are near enough for colours.
"""

import base64
import json
import zlib
from html import escape
from pathlib import Path

import numpy as np

from pagas_cl.app.report.page import html_page, slider
from pagas_cl.app.report.pictures import MAPS, css_gradient
from pagas_cl.method.surface.weld import compact, with_area
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check.patches import area_of, spread_over
from pagas_cl.scene.mesh import triangle_normals, vertex_normals
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.system.files import write_text

MOST_TRIANGLES = 200_000   # of each mesh in a page: some 2.5 MB
SCRIPTS = ["viewer.js"]
_NOTHING = 255             # of a value that is stored in 8 bits
_MOST_CELLS = 1 << 19      # along an axis, so that a cell's number fits into 64 bits
_SIZES = 8                 # that are tried of a cell
_PART = 1 << 18            # triangles at a time
_STAY = 0.02               # weight of staying at the mean of a cell's vertices, as a share of that of the planes
_SAMPLES = 300_000         # points on the surface that distances are taken to
_SEARCHES = 4              # each four times as wide as the one before, for what was not found yet


def mesh_viewer(before, after, *, camera: Camera | None = None, most: int = MOST_TRIANGLES) -> str:
    """HTML of the viewer, for a page with SCRIPTS; the mesh after also in colours of how far it has moved.

    `before` (or None) and `after` are whatever refine_mesh takes, seen from `camera` at first, else from the side to
    which most of the mesh after looks; of more than `most` triangles it is simplified. InputError for what is no mesh.
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


def simplify(vertices, faces, most: int):
    """At most `most` triangles of a mesh (V, 3), (F, 3): vertices float64 (W, 3), faces int32 (G, 3).

    Of a mesh that has no more the vertices that no triangle has are left out alone.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    used, faces = compact(len(vertices), faces)
    vertices = vertices[used]
    if len(faces) <= most:
        return vertices, faces
    corner = vertices.min(axis=0)
    local = vertices - corner
    area = sum(np.linalg.norm(triangle_normals(local, faces[part]), axis=1).sum() for part in _parts(len(faces)))
    cell = max(np.sqrt(area / most), local.max() / _MOST_CELLS, 1e-300)
    for _ in range(_SIZES):
        cells, fewer = _clustered(local, faces, cell)
        if len(fewer) <= most:
            break
        cell *= max(1.02, 1.01 * np.sqrt(len(fewer) / most))
    return _placed(local, faces, cells, cell) + corner, fewer


def _parts(number: int):
    """Slices of so many triangles, so that what is computed of each stays small."""
    return (slice(start, start + _PART) for start in range(0, number, _PART))


def _clustered(local, faces, cell):
    """Number of each vertex's cell, and the triangles that still have three corners, each of them once."""
    index = np.floor(local / cell).astype(np.int64)
    _, cells = np.unique(_key(index, index.max(axis=0) + 1), return_inverse=True)
    cells = cells.reshape(-1).astype(np.int32)
    corners = with_area(cells[faces])
    first = np.sort(np.unique(np.sort(corners, axis=1), axis=0, return_index=True)[1])
    return cells, corners[first]


def _placed(local, faces, cells, cell):
    """Of each cell the point nearest to the planes of its triangles, by area, and to the mean of its vertices."""
    count = int(cells.max()) + 1
    number = np.bincount(cells, minlength=count)
    mean = np.stack([np.bincount(cells, local[:, k], count) / number for k in range(3)], axis=1)
    planes, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for part in _parts(len(faces)):
        normal = triangle_normals(local, faces[part])
        area = np.linalg.norm(normal, axis=1)
        normal /= np.where(area > 0, area, 1)[:, None]
        for corner in faces[part].T:
            at = cells[corner]
            away = ((local[corner] - mean[at]) * normal).sum(axis=1) * area
            for i in range(3):
                pull[:, i] += np.bincount(at, away * normal[:, i], count)
                for j in range(i, 3):
                    planes[:, i, j] += np.bincount(at, area * normal[:, i] * normal[:, j], count)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        planes[:, i, j] = planes[:, j, i]
    trace = np.trace(planes, axis1=1, axis2=2)
    stay = _STAY * trace + 1e-9 * max(trace.max(), 1e-300)
    move = np.linalg.solve(planes + stay[:, None, None] * np.eye(3), pull[..., None])[..., 0]
    return mean + np.clip(move, -cell, cell)


def moved_by(points, vertices, faces) -> np.ndarray:
    """Distance of `points` (n, 3) from the surface (V, 3), (F, 3): float64 (n,), scene units.

    Above 0 on the side to which the faces' normals point; NaN where no surface is near.
    """
    points, vertices, faces = np.asarray(points, np.float64), np.asarray(vertices, np.float64), np.asarray(faces)
    samples, normals = spread_over(vertices, faces, _SAMPLES)
    away = np.full(len(points), np.nan)
    if not len(samples):
        return away
    spacing = max(np.sqrt(area_of(vertices, faces) / _SAMPLES), np.ptp(samples, axis=0).max() / _MOST_CELLS)
    left = np.arange(len(points))
    for k in range(_SEARCHES):
        each, wide = 16**k, 3 * spacing * 4**k
        near, distance = _nearest(points[left], samples[::each], wide)
        found = distance <= wide
        index, near, distance = left[found], near[found] * each, distance[found]
        along = ((points[index] - samples[near]) * normals[near]).sum(axis=1)
        if k:  # samples are far apart: is the surface where the point's foot is, or does it end before?
            below, gap = _nearest(points[index] - along[:, None] * normals[near], samples, 3 * spacing)
            there = gap <= 3 * spacing
            under = ((points[index] - samples[below]) * normals[below]).sum(axis=1)
            along = np.where(there, under, np.copysign(distance, along))
        away[index] = along
        left = left[~found]
        if not len(left):
            break
    return away


def _nearest(points, samples, wide):
    """Index of the nearest of the samples in the cells of size `wide` around each point, and its distance."""
    low = samples.min(axis=0) - 2 * wide
    cells = np.floor((samples - low) / wide).astype(np.int64)
    size = cells.max(axis=0) + 3
    keys = _key(cells, size)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    home = np.floor((points - low) / wide)
    inside = ((home >= 1) & (home < size - 1)).all(axis=1)
    near, best = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    who = np.flatnonzero(inside)
    home = home[who].astype(np.int64)
    for shift in np.ndindex(3, 3, 3):
        key = _key(home + np.array(shift) - 1, size)
        start, stop = np.searchsorted(keys, key), np.searchsorted(keys, key, side="right")
        place = np.flatnonzero(start < stop)
        while len(place):
            candidate, at = order[start[place]], who[place]
            distance = np.linalg.norm(points[at] - samples[candidate], axis=1)
            closer = distance < best[at]
            near[at[closer]], best[at[closer]] = candidate[closer], distance[closer]
            start[place] += 1
            place = place[start[place] < stop[place]]
    return near, best


def _key(cells, size):
    return (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
