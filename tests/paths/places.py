"""What the names in braces of the table's COMMANDS stand for; made when a row needs it first."""

from contextlib import ExitStack
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from paths.truth import Scenes
from support.example_scenes import write_example
from support.job_scenes import write_small_scene
from support.synthetic.mesh import solid_mesh

from pagas_cl.runtime.device import Device
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import read_mesh, write_mesh
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.readers.meshlab import MeshLayer, write_project


class Places:
    """Files and names below `folder`; `stack` ends the cluster's processes."""

    def __init__(self, folder: Path, opened: Device, stack: ExitStack):
        self.folder, self.device, self.stack = folder, opened.info.name, stack
        self.scenes = Scenes(folder, held_out=1)

    def arguments(self, of_row: str, out: Path) -> list[str]:
        """The arguments of a row, names in braces replaced; `out`: the folder that it writes to."""
        return [word.format(at=self, out=out) for word in of_row.replace("{", "{at.").replace("{at.out}",
                                                                                                "{out}").split()]

    @cached_property
    def scene(self) -> Path:
        return self.scenes.path("0")

    @cached_property
    def off_by_1(self) -> Path:
        return self.scenes.path("1")

    @property
    def mesh(self) -> Path:
        return self.scene / "mesh_coarse.ply"

    @property
    def maps(self) -> Path:
        return self.scene / "depth_initial"

    @property
    def true_maps(self) -> Path:
        return self.scene / "depth_true"

    @cached_property
    def true_mesh(self) -> Path:
        made = self.scenes.made
        path = self.folder / "true.ply"
        write_mesh(path, Surface(*solid_mesh(made.true_solid, 2 * made.relief.footprint, (60.0, 50.0))))
        return path

    @cached_property
    def small(self) -> Path:
        """Four views of 64 x 48."""
        return write_small_scene(self.folder / "small", 4)

    @cached_property
    def network(self) -> Path:
        """What a network has left, with the original photos next to it."""
        return write_example(self.folder / "network", "mapanything-colmap", self.scenes.made)

    @cached_property
    def visible(self) -> Path:
        """DTU's mask of the space that its scanner saw: all around the mesh."""
        savemat, (low, high) = pytest.importorskip("scipy.io").savemat, self._box
        path = self.folder / "ObsMask.mat"
        savemat(path, {"ObsMask": np.ones((8, 8, 8), np.uint8), "BB": [low, high], "Res": max(high - low) / 8})
        return path

    @cached_property
    def ground(self) -> Path:
        """DTU's plane under the object."""
        savemat, (low, _) = pytest.importorskip("scipy.io").savemat, self._box
        path = self.folder / "Plane.mat"
        savemat(path, {"P": np.array([[0.0], [0.0], [1.0], [-low[2]]])})
        return path

    @cached_property
    def _box(self):
        vertices = read_mesh(self.mesh).vertices
        return vertices.min(axis=0) - 50, vertices.max(axis=0) + 50

    @cached_property
    def script(self) -> Path:
        """A filter script with our step in it."""
        path = self.folder / "script.mlx"
        path.write_text('<!DOCTYPE FilterScript>\n<FilterScript>\n<filter name="PAGaS Depth Refinement">'
                        '<Param type="RichString" name="settings" value="pyramid.steps=8"/></filter>\n'
                        '<filter name="Re-Compute Vertex Normals"/>\n</FilterScript>\n')
        return path

    @cached_property
    def project(self) -> Path:
        """A MeshLab project of the scene and its mesh."""
        return write_project(self.scene / "project.mlp", read_scene(self.scene).views,
                             [MeshLayer("coarse", self.mesh, np.eye(4))])

    @cached_property
    def scheduler(self) -> str:
        """The address of a Dask cluster with one worker."""
        from test_cluster import Cluster

        (self.folder / "cluster").mkdir()
        cluster = Cluster(self.folder / "cluster", self.stack)
        cluster.add("127.0.0.1")
        cluster.ready(1)
        return cluster.address
