"""The picture of the README: photo, normals of the input, normals of the result, normals of the truth.

    python tests/bench/picture.py [--device NAME] [--out .github/refined.png]
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
from pagas_cl.app.report.pictures import normal_colors
from pagas_cl.result import normals_of

WIDTH, HEIGHT, BORDER = 480, 360, 6


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default=None)
    parser.add_argument("--out", default=".github/refined.png")
    given = parser.parse_args()
    made = relief_scene(WIDTH, HEIGHT, 5, held_out=0)
    target, *contexts = made.views
    initial = made.initial_depth(target.camera)
    result = refine_depth(target, contexts, initial, device=given.device)
    pictures = [target.load_image()]
    for depth in (initial, result.depth, made.true_depth(target.camera)):
        normals = normals_of(depth, target.camera)
        pictures.append(np.asarray(normal_colors(normals, (normals**2).sum(axis=-1) > 0))[..., :3])
    cut = (slice(40, 300), slice(80, 400))
    gap = np.full((260, BORDER, 3), 255, np.uint8)
    row = [part for picture in pictures for part in (picture[cut], gap)][:-1]
    Image.fromarray(np.concatenate(row, axis=1)).save(Path(given.out), optimize=True)


if __name__ == "__main__":
    main()
