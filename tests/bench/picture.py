"""The picture of the README: photo, normals of the input, of the result, of the truth; or meshes, shaded as a
photo of a scene sees them (docs/gallery.md).

    python tests/bench/picture.py [--device NAME] [--out .github/refined.png]
    python tests/bench/picture.py --scene SCENE --view NAME --meshes a.ply b.ply --crop X Y W H --out c.jpg
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from PIL import Image
from support.synthetic import relief_scene

from pagas_cl import refine_depth
from pagas_cl.app.report.pictures import normal_colors, shaded
from pagas_cl.refine import initial_depths
from pagas_cl.result import normals_of
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import View

WIDTH, HEIGHT, BORDER = 480, 360, 6


def made_scene(device) -> tuple[list[np.ndarray], tuple]:
    """Pictures of a synthetic relief, and the part of them that is shown."""
    made = relief_scene(WIDTH, HEIGHT, 5, held_out=0)
    target, *contexts = made.views
    initial = made.initial_depth(target.camera)
    result = refine_depth(target, contexts, initial, device=device)
    pictures = [target.load_image()]
    for depth in (initial, result.depth, made.true_depth(target.camera)):
        normals = normals_of(depth, target.camera)
        pictures.append(np.asarray(normal_colors(normals, (normals**2).sum(axis=-1) > 0))[..., :3])
    return pictures, (slice(40, 300), slice(80, 400))


def of_meshes(view: View, meshes, crop) -> tuple[list[np.ndarray], tuple]:
    """The meshes of these files shaded as the view sees them, and the part of them that is shown."""
    depths = [initial_depths(to_surface(mesh), [view])[0] for mesh in meshes]
    left, top, width, height = crop or (0, 0, view.camera.width, view.camera.height)
    return [shaded(depth, view.camera) for depth in depths], (slice(top, top + height), slice(left, left + width))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--out", default=".github/refined.png")
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--view")
    parser.add_argument("--meshes", nargs="*", type=Path, default=[])
    parser.add_argument("--crop", nargs=4, type=int)
    parser.add_argument("--wide", type=int, default=1400, help="pixels of the whole picture, at most")
    given = parser.parse_args()
    if given.scene is None:
        pictures, cut = made_scene(given.device)
    else:
        scene = read_scene(given.scene)
        pictures, cut = of_meshes(scene.views[scene.index(given.view)], given.meshes, given.crop)
    gap = np.full((pictures[0][cut].shape[0], BORDER, 3), 255, np.uint8)
    whole = Image.fromarray(np.concatenate([part for picture in pictures for part in (picture[cut], gap)][:-1], axis=1))
    whole.thumbnail((given.wide, given.wide))
    whole.save(Path(given.out), optimize=True)


if __name__ == "__main__":
    main()
