"""What `refine` is to make, where it goes, and what it may take: checked before any work is done."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from pagas_cl.app.commands._given import Given
from pagas_cl.app.commands._outputs import check_outputs, page_files
from pagas_cl.app.report import picture_files
from pagas_cl.config import Config, Fusion
from pagas_cl.config.presets import apply_settings
from pagas_cl.errors import InputError, log, need
from pagas_cl.method.surface.blocks import cut
from pagas_cl.method.surface.fuse import plan_with_blocks
from pagas_cl.method.surface.keep_mesh import check_kept
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.progress import Progress, stage
from pagas_cl.scene.meshes.files import check_digits_of_scene, check_mesh_path
from pagas_cl.scene.readers import camera_file
from pagas_cl.scene.view import View


@dataclass(frozen=True)
class Wanted:
    """The options of these names, `numbers` those for the mesh alone; `mesh` may be one that was found in the scene."""

    mesh: Path | None
    depth_dir: Path | None
    output: Path | None
    save_depth: Path | None
    report: Path | None
    keep_mesh: bool
    allow_loss: bool
    fuse: bool
    numbers: MeshOptions
    overwrite: bool
    hold_out: list[str]

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
        return replace(self.numbers, output=None if self.output is None else output)

    @property
    def folder(self) -> Path | None:
        """Where finished views are kept: with the depth maps, or next to the mesh until it is written; with all that a
        later run may need of them, so that nothing is refined again for it."""
        return self.next_to_mesh if self.save_depth is None else self.save_depth

    @property
    def next_to_mesh(self) -> Path | None:
        """The folder next to the mesh, by which runs know that one is at work on it."""
        return self.output and self.output.parent / f".{self.output.name}.views"

    def check(self) -> None:
        """Before the scene is read: refuse what cannot end well."""
        if self.output is None and self.save_depth is None and self.report is None:
            start = "" if self.mesh or self.depth_dir else ("; and, where SCENE holds no surface itself, either --mesh "
                                                            "or --depth-dir")
            raise InputError(f"nothing to write: give --output, --save-depth or --report{start}")
        if self.output is not None:
            check_mesh_path(self.output)
            if self.numbers.color and self.output.suffix.lower() == ".stl":
                raise InputError(f"--color: {str(self.output)!r} cannot hold colours; write .ply, .obj, .off or .glb")
        for_mesh = {"--fuse": self.fuse, "--keep-mesh": self.keep_mesh, "--color": self.numbers.color,
                    **{f"--{name}": getattr(self.numbers, name) for name in ("subdivide", "tolerance", "triangles")}}
        unused = [name for name, value in for_mesh.items() if value and self.output is None]
        if unused:
            raise InputError(f"{unused[0]} is for the mesh, which no --output names: give one, or leave out "
                             f"{unused[0]}")
        if self.keep_mesh and self.fuse:
            raise InputError("--keep-mesh and --fuse do not go together: give one of them")
        for name in ("tolerance", "triangles"):
            if self.keep_mesh and getattr(self.numbers, name) is not None:
                raise InputError(f"--{name} and --keep-mesh do not go together: that keeps the triangles")
        if self.allow_loss and not self.keep_mesh:
            raise InputError("--allow-loss goes with --keep-mesh: other meshes lose nothing that is not said")

    def check_places(self, given: Given) -> None:
        """Refuse to write where something is read, and over what pagas_cl has not written."""
        names = given.names or [view.name for view in given.scene.views]
        pictures = picture_files(names, None not in (self.output, given.mesh))
        files = [*page_files(self.report, "report.json", pictures, self.overwrite), ("--output", self.output),
                 ("the cameras in --save-depth", self.save_depth and self.save_depth / camera_file.NAME)]
        folders = [("--save-depth", self.save_depth), ("--report", self.report)]
        check_outputs(files, folders, given.inputs, self.overwrite)

    def check_mesh(self, views: Sequence[View]) -> None:
        """Once the mesh is known: refuse options that change nothing, and a mesh that cannot be as it should."""
        if self.keep_mesh and self.mesh is None:
            raise InputError("--keep-mesh needs a start from a mesh (--mesh, or one in SCENE): it moves its vertices")
        for name in ("subdivide", "tolerance", "triangles"):
            if getattr(self.numbers, name) is not None and (self.mesh is None or self.fuse):
                raise InputError(f"--{name} needs a start from a mesh (--mesh, or in SCENE) without --fuse: a fused "
                                 "mesh has the voxel's fineness (--set fusion.voxel=...)")
        self.making.check()
        if self.refines_mesh:
            check_kept(self.output, self.mesh, self.allow_loss or not self.keep_mesh)
        elif self.output is not None:
            check_digits_of_scene(self.output, np.array([view.camera.center for view in views]))
            need("open3d", "mesh", "fusing depth maps to a mesh (--output without --mesh, or with --fuse)")
        memory = self.numbers.memory_mb
        if memory is not None and (self.output is None or self.keep_mesh):
            log.warning("--memory %g changes nothing: no mesh is fused, and none gets as many triangles as fit", memory)


def check_times(per_view: float | None, budget: float | None, preset: str, several: bool) -> None:
    """Refuse what contradicts itself; `several`: the work is done on several devices."""
    if per_view is None and budget is None:
        return
    if per_view is not None and budget is not None:
        raise InputError("expected --time-per-view or --time-budget, got both")
    name = "--time-budget" if per_view is None else "--time-per-view"
    if several:
        raise InputError(f"{name} measures one device: leave out --devices and --scheduler, or choose the settings "
                         "with --preset")
    if preset != "balanced":
        raise InputError(f"{name} chooses the settings itself: leave out --preset {preset} (--set and --context hold)")


def within_time(config: Config, views, depths, names, device, progress: Progress, *, per_view: float | None,
                budget: float | None, preset: str, settings: list[str]) -> tuple[Config, str]:
    """`config` where there is no limit, else the best settings whose expected time fits, which are logged: seconds
    `per_view`, or minutes for all views (`budget`); and what they are called, for the report.

    `settings` are applied to all that are tried, and were to `preset`, for `config`; the other arguments are as in
    refine_views. Whether cameras are refined is decided already, in `config`.
    """
    if per_view is None and budget is None:
        return config, ", ".join([preset, *settings])
    from pagas_cl.app.tradeoffs.costs import RUNS, Costs

    with stage(progress, "time the settings", RUNS) as timing:
        runs = count(1)
        costs = Costs(views, depths, device, names, lambda: timing.advance(min(next(runs), RUNS - 1)))
        number = len(costs.pixels)
        name, config, seconds = costs.choose(60 * budget / number if per_view is None else per_view,
                                             partial(apply_settings, assignments=settings,
                                                     effects__cameras=config.effects.cameras))
        timing.advance(RUNS)
    log.info("settings: %s, about %.3g s per view, %.3g minutes for %d views (reading the mesh and fusing not counted)",
             name, seconds, seconds * number / 60, number)
    return config, ", ".join([name, *settings])


def check_fusion(views: Sequence[View], depths: Sequence, settings: Fusion, memory_mb: float) -> None:
    """Before views are refined: InputError where their `depths`, as they are now, cannot be fused in `memory_mb`."""
    plan, blocks = plan_with_blocks(views, depths, settings, [])
    if plan.memory_mb > memory_mb:
        cut(plan, blocks, memory_mb, views)
