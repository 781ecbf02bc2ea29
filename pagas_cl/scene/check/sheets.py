"""A coarse mesh of depth maps to compare photos over, without Open3D: each view its own sheet."""

from collections.abc import Sequence

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check.patches import evenly
from pagas_cl.scene.depthmap import depth_down
from pagas_cl.scene.inputs import Depth, depth_array
from pagas_cl.scene.mesh import Surface, grid_faces

_SIDE, _VIEWS = 96, 6      # pixels of the maps' longer side; views that are taken
_EDGE = 0.05               # triangles whose depths differ by more than this share span a depth edge


def mesh_of_depths(cameras: Sequence[Camera], depths: Sequence[Depth | None]) -> Surface:
    """Triangles between neighbouring pixels of a few of the depth maps (None where a view has none), made small."""
    have = [k for k, depth in enumerate(depths) if depth is not None]
    chosen = [have[n] for n in evenly(len(have), _VIEWS)] if have else []
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    for k in chosen:
        full = depth_array(depths[k])
        scale = min(1.0, _SIDE / max(full.shape))
        camera = cameras[k].resized(max(2, round(full.shape[1] * scale)), max(2, round(full.shape[0] * scale)))
        depth = depth_down(full, camera.width, camera.height).astype(np.float64)
        points = (camera.rays() * depth[..., None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        found = grid_faces(camera.width, camera.height)
        at = depth.ravel()[found]
        kept = found[(at > 0).all(axis=1) & (at.max(axis=1) < (1 + _EDGE) * at.min(axis=1))]
        used, renumbered = np.unique(kept, return_inverse=True)
        vertices.append(points.reshape(-1, 3)[used])
        faces.append(renumbered.reshape(-1, 3) + count)
        count += len(used)
    if not count:
        raise InputError("no depth map has a surface: nothing can be compared with the photos")
    return Surface(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
