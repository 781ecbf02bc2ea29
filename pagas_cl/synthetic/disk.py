"""A synthetic scene as a folder that every command takes: photos, cameras, masks, coarse mesh, initial and
true depth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from pagas_cl.synthetic.scene import SyntheticScene


def write_scene(synthetic: SyntheticScene, folder) -> Path:
    """Write SCENE/images, cameras.json, masks, mesh_coarse.ply, depth_initial and depth_true; returns SCENE.

    The held-out views are in the folder too, under names that start with "held_out".
    """
    from pagas_cl.scene.depthmap import save_depth
    from pagas_cl.scene.readers import camera_file

    folder = Path(folder)
    for name in ("images", "depth_initial", "depth_true", *(["masks"] if synthetic.relief.foreground else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    named = []
    for view in synthetic.all_views:
        file = f"{view.name}.png"
        _write_png(folder / "images" / file, view.load_image())
        if view.mask is not None:
            _write_png(folder / "masks" / file, view.load_mask().astype(np.uint8) * 255)
        save_depth(folder / "depth_initial" / f"{view.name}.npz", synthetic.initial_depth(view.camera))
        save_depth(folder / "depth_true" / f"{view.name}.npz", synthetic.true_depth(view.camera))
        named.append(replace(view, mask=None, name=file))
    camera_file.write(folder, named)
    write_ply(folder / "mesh_coarse.ply", *synthetic.initial_mesh())
    return folder


def write_ply(path, vertices, faces) -> None:
    """Write a triangle mesh as binary PLY, double coordinates."""
    path = Path(path)
    header = ("ply\nformat binary_little_endian 1.0\n"
              f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
              f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("face", "<i4", 3)]))
    rows["count"], rows["face"] = 3, faces
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.ascontiguousarray(vertices, "<f8").tobytes())
        file.write(rows.tobytes())
    os.replace(part, path)


def _write_png(path, pixels):
    part = path.with_name(path.name + ".part")
    Image.fromarray(pixels).save(part, "PNG")
    os.replace(part, path)
