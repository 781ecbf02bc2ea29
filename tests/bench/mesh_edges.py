"""The picture of edges in MESH.md: `python tests/bench/mesh_edges.py OUT.png [--preset balanced] [SCENE ...]`. A row a
scene (detail, a wire, a border, a step and a crease), five times enlarged: given, fused, `output="mesh"`, truth."""

from __future__ import annotations

import argparse

import mesh
import mesh_scenes
import numpy as np
from PIL import Image

from pagas_cl.method.surface.keep_mesh import solve_device
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.result import normals_of
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.mesh import Surface

SPOTS = {"relief": (0, 60, 50), "wires": (0, 130, 80), "sheet": (0, 30, 60), "box": (5, 120, 70)}   # view, column, row
WIDE, HIGH, ZOOM, GAP = 50, 38, 5, 4
LIGHT = np.array([-0.45, -0.55, -0.7]) / np.linalg.norm([-0.45, -0.55, -0.7])


def shaded(surface: Surface, camera: Camera) -> np.ndarray:
    depth = next(each_depth(surface, [camera], solve_device(None)))
    light = np.where(depth > 0, np.clip(0.25 + 0.75 * (normals_of(depth, camera) @ LIGHT), 0, 1), 1)
    return np.pad((255 * light).astype(np.uint8), ((0, GAP), (0, GAP)), constant_values=255)


def row(name: str, preset: str) -> np.ndarray:
    scene = getattr(mesh_scenes, name)()
    view, column, line = SPOTS[name]
    whole = scene.cameras[view]
    camera = Camera(WIDE * ZOOM, HIGH * ZOOM, whole.fx * ZOOM, whole.fy * ZOOM, (whole.cx - column) * ZOOM,
                    (whole.cy - line) * ZOOM, whole.world_to_camera, whole.name)
    found = dict(mesh.outputs(scene, preset))
    return np.concatenate([shaded(surface, camera) for surface in (
        found["given"], found["tsdf"], found["mesh"], Surface(*scene.true))], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out")
    parser.add_argument("scenes", nargs="*", default=list(SPOTS))
    parser.add_argument("--preset", default="balanced")
    asked = parser.parse_args()
    rows = np.concatenate([row(name, asked.preset) for name in asked.scenes])
    Image.fromarray(rows).quantize(32).save(asked.out, optimize=True)


if __name__ == "__main__":
    main()
