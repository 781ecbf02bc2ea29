"""A synthetic scene as a folder that every command takes."""

from __future__ import annotations

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
    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.mesh_file import write_mesh
    from pagas_cl.scene.readers import camera_file

    folder = Path(folder)
    for name in ("images", "depth_initial", "depth_true", *(["masks"] if synthetic.relief.foreground else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    named = []
    for view in synthetic.all_views:
        file = f"{view.name}.png"
        Image.fromarray(view.load_image()).save(folder / "images" / file)
        if view.mask is not None:
            Image.fromarray(view.load_mask().astype(np.uint8) * 255).save(folder / "masks" / file)
        save_depth(folder / "depth_initial" / f"{view.name}.npz", synthetic.initial_depth(view.camera))
        save_depth(folder / "depth_true" / f"{view.name}.npz", synthetic.true_depth(view.camera))
        named.append(replace(view, mask=None, name=file))
    camera_file.write(folder, named)
    write_mesh(folder / "mesh_coarse.ply", Surface(*synthetic.initial_mesh()))
    return folder
