"""Readings of cameras' numbers that people and programs mix up, each with what mends it."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pagas_cl.scene.camera import FLIP, Camera, inverse_pose


class Change(NamedTuple):
    """A reading of cameras' numbers: what it does to one, what mends it in Python and in files, its matrices' name."""

    name: str
    of: Callable[[Camera], Camera]
    mend: str
    in_files: str = ""
    matrices: str = ""


def _posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Camera], Camera]:
    return lambda camera: replace(camera, world_to_camera=change(camera.world_to_camera))


POSES = (
    Change("as given", lambda camera: camera, ""),
    Change("inverted", _posed(inverse_pose), "Camera.from_c2w(K, matrix, ...)",
           "the scene's files hold camera-to-world poses where world-to-camera ones belong (as in images.txt): "
           "invert each pose there", "the inverse matrices"),
    Change("y and z flipped", _posed(lambda m: FLIP @ m),
           "Camera.from_opengl_c2w(K, camera_to_world, ...), with the camera-to-world matrices",
           "the scene's files hold poses with OpenGL's axes: turn the signs of the second and third row of each "
           "world-to-camera matrix there", "y and z flipped (OpenGL axes)"),
    Change("inverted, y and z flipped", _posed(lambda m: FLIP @ inverse_pose(m)),
           "Camera.from_opengl_c2w(K, matrix, ...)",
           "the scene's files hold camera-to-world poses with OpenGL's axes: write them as a transforms.json "
           "(--format nerfstudio), which means them so", "the inverse matrices and y and z flipped (OpenGL axes)"),
)
_Y_FOR_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])      # a quarter turn about x


def _turn(quarters: int, becomes: str) -> Change:
    """As if the mesh were turned about x: other programs take y for up, or z."""
    how = f"put y, z of each of its points to {becomes}"
    return Change(f"for a mesh turned by {90 * quarters} degrees about x",
                  _posed(lambda m: m @ np.linalg.matrix_power(_Y_FOR_Z, quarters)), f"the mesh so turned: {how}",
                  f"another program has turned the mesh, which took y for up, or z: {how}")


ROTATED = (_turn(1, "-z, y"), _turn(-1, "z, -y"), _turn(2, "-y, -z"))
DETAILS = (
    Change("principal point from the bottom", lambda camera: replace(camera, cy=camera.height - camera.cy),
           "cy = height - cy (in MeshLab projects: flavour='openmvs' or 'meshlab')",
           "the scene's files count cy from the bottom: put height - cy there (MeshLab projects: --mlp-flavour)"),
    Change("half a pixel more", lambda camera: replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5),
           "pixel_center=0 in the constructor (K counts pixel centres at whole numbers)",
           "the scene's files count pixel centres at whole numbers: add 0.5 to cx and cy there"),
    Change("half a pixel less", lambda camera: replace(camera, cx=camera.cx - 0.5, cy=camera.cy - 0.5),
           "pixel_center=0.5 in the constructor (K counts pixel centres at +0.5)",
           "the scene's files count pixel centres at +0.5: subtract 0.5 from cx and cy there"),
)
