"""What `refine` is to make, and where it goes: checked before any work is done."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pagas_cl.app.commands._given import Given
from pagas_cl.app.commands._outputs import check_outputs, page_files
from pagas_cl.app.report import picture_files
from pagas_cl.errors import InputError, log, need
from pagas_cl.method.surface.keep_mesh import check_kept
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.scene.meshes.files import check_digits_of_scene, check_mesh_path
from pagas_cl.scene.readers import camera_file


@dataclass(frozen=True)
class Wanted:
    """The options of these names; `mesh` may also be one that was found in the scene."""

    mesh: Path | None
    depth_dir: Path | None
    photos: Path | None
    output: Path | None
    save_depth: Path | None
    report: Path | None
    keep_mesh: bool
    allow_loss: bool
    subdivide: float | None
    tolerance: float | None
    triangles: int | None
    fuse: bool
    memory: float | None
    color: bool
    overwrite: bool

    @property
    def refines_mesh(self) -> bool:
        """Whether `output` is `mesh`, refined."""
        return None not in (self.output, self.mesh) and not self.fuse

    @property
    def fuses_mesh(self) -> bool:
        """Whether `output` is a new mesh."""
        return self.output is not None and not self.refines_mesh

    @property
    def making(self) -> MeshOptions:
        """What comes of the depth maps."""
        output = "tsdf" if self.fuses_mesh else "displace" if self.keep_mesh else "mesh"
        return MeshOptions(None if self.output is None else output, self.subdivide, self.tolerance, self.triangles,
                           self.memory, self.color)

    @property
    def folder(self) -> Path | None:
        """Where finished views are kept: with the depth maps, or next to the mesh until it is written; with all that a
        later run may need of them, so that nothing is refined again for it."""
        if self.save_depth is None and self.output is not None:
            return self.output.parent / f".{self.output.name}.views"
        return self.save_depth

    def check(self) -> None:
        """Before the scene is read: refuse what cannot end well."""
        if self.output is None and self.save_depth is None and self.report is None:
            start = "" if self.mesh or self.depth_dir else ("; and, where SCENE holds no surface itself, either --mesh "
                                                            "or --depth-dir")
            raise InputError(f"nothing to write: give --output, --save-depth or --report{start}")
        if self.output is not None:
            check_mesh_path(self.output)
            if self.color and self.output.suffix.lower() == ".stl":
                raise InputError(f"--color: {str(self.output)!r} cannot hold colours; write .ply, .obj, .off or .glb")
        if self.keep_mesh and self.fuse:
            raise InputError("--keep-mesh and --fuse do not go together: give one of them")
        if self.allow_loss and not self.keep_mesh:
            raise InputError("--allow-loss goes with --keep-mesh: other meshes lose nothing that is not said")

    def check_mesh_options(self) -> None:
        """Once it is known whether there is a mesh: refuse options that would change nothing."""
        if self.keep_mesh and self.mesh is None:
            raise InputError("--keep-mesh needs a start from a mesh (--mesh, or one in SCENE): it moves its vertices")
        for name in ("subdivide", "tolerance", "triangles"):
            if getattr(self, name) is not None and (self.mesh is None or self.fuse):
                raise InputError(f"--{name} needs a start from a mesh (--mesh, or in SCENE) without --fuse: a fused "
                                 "mesh has the voxel's fineness (--set fusion.voxel=...)")
        self.making.check()

    def check_places(self, scene: Path, given: Given, names: list[str] | None) -> None:
        """Refuse to write where something is read, and over what pagas_cl has not written; `names`: of the views to
        refine, None for all."""
        all_names = [view.name for view in given.scene.views]
        pictures = picture_files(names or all_names, None not in (self.output, given.mesh))
        files = [*page_files(self.report, "report.json", pictures, self.overwrite), ("--output", self.output),
                 ("the cameras in --save-depth", self.save_depth and self.save_depth / camera_file.NAME)]
        inputs = {**given.inputs(scene, self.mesh, self.depth_dir), "--photos": self.photos}
        check_outputs(files, [("--save-depth", self.save_depth), ("--report", self.report)], inputs, self.overwrite)

    def check_mesh(self, views) -> None:
        """Refuse a mesh that cannot be made, or written, as it should be."""
        if self.refines_mesh:
            check_kept(self.output, self.mesh, self.allow_loss or not self.keep_mesh)
        elif self.output is not None:
            check_digits_of_scene(self.output, np.array([view.camera.center for view in views]))
            need("open3d", "mesh", "fusing depth maps to a mesh (--output without --mesh, or with --fuse)")
        if self.memory is not None and (self.output is None or (self.keep_mesh and self.subdivide is None)):
            log.warning("--memory %g changes nothing: no mesh is fused, and no edge of one is split", self.memory)
