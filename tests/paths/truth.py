"""Made scenes on disk whose surface is known exactly, and how far depth maps and meshes are from it."""

import shutil
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from support.camera_noise import noisy
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.method.surface.agree import comparison_device
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.meshes.files import read_mesh
from pagas_cl.scene.readers import camera_file


def scenes_of_columns(folder: Path) -> dict[str, "Scenes"]:
    """By how far cameras are off. Those off by 3 pixels come back with five views, not with four."""
    four, five = (Scenes(folder / f"{contexts}", contexts=contexts) for contexts in (3, 4))
    return {"0": four, "1": four, "3": five}


class Scenes:
    """One scene with cameras that are right (`path("0")`), or off by 1 or 3 pixels."""

    def __init__(self, folder: Path, **settings):
        self.folder = folder
        self.made = relief_scene(**{"width": 96, "height": 72, "contexts": 4, "held_out": 0, **settings})
        self.cameras = [view.camera for view in self.made.views]

    def path(self, off: str) -> Path:
        """The folder of the scene; written when it is needed first."""
        folder = self.folder / f"off_by_{off}"
        if folder.exists():
            return folder
        write_scene(self.made, folder)
        views = [replace(view, mask=None, name=f"{view.name}.png") for view in self.made.all_views]
        if off != "0":
            cameras = noisy([view.camera for view in views], float(off), seed=0)
            views = [replace(view, camera=camera) for view, camera in zip(views, cameras)]
        camera_file.write(folder, views)
        return folder

    def copy(self, off: str, to: Path) -> Path:
        return shutil.copytree(self.path(off), to)

    @cached_property
    def before(self) -> float:
        """Error of the coarse mesh."""
        return self.of_mesh(self.path("0") / "mesh_coarse.ply", self.cameras)

    def of_maps(self, folder: Path) -> float:
        """Error of a folder of depth maps."""
        return self.error([load_depth(folder / f"{camera.name}.npz") for camera in self.cameras])

    def of_mesh(self, path: Path, cameras) -> float:
        """Error of a mesh, as `cameras` see it: the true ones, or those that its depth maps came with."""
        return self.error(list(each_depth(read_mesh(path), cameras, comparison_device(None))))

    def error(self, depths) -> float:
        """Mean distance from the truth, pixels of parallax, once the scale that fits best is taken out: where cameras
        are off their photos do not show it."""
        truth = [self.made.true_depth(camera) for camera in self.cameras]
        seen = [(depth > 0) & (true > 0) for depth, true in zip(depths, truth)]
        found, true = (np.concatenate([depth[there] for depth, there in zip(those, seen)]).astype(np.float64)
                       for those in (depths, truth))
        return float(np.abs(np.median(true / found) * found - true).mean() / self.made.relief.parallax)
