"""What a command was given: format, photos, cameras and surface, found by looking and logged; and where it works."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pagas_cl.app.commands._outputs import scene_inputs
from pagas_cl.app.commands._process import opened_device
from pagas_cl.errors import InputError, log, short
from pagas_cl.jobs.pools import check_address
from pagas_cl.jobs.work_folder import work_folder
from pagas_cl.method.surface.align_depth_scales import align_depth_scales
from pagas_cl.progress import Progress
from pagas_cl.runtime.device import Device
from pagas_cl.scene.depth.formats import SUFFIXES as DEPTH_SUFFIXES
from pagas_cl.scene.depth.source import of_photo
from pagas_cl.scene.depthmap import find_depth, find_depths
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.meshes.files import SUFFIXES, read_content
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.meshes.ply import read_header
from pagas_cl.scene.names import file_stems
from pagas_cl.scene.own_files import is_own_mesh
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import Scene

DEPTH_FOLDERS = ("mvsa_predictions", "depth", "depths", "depth_maps", "stereo/depth_maps", "depth_initial")
_GIVE_UNIT = "give --depth-scale (1000 for millimetres in a scene of metres)"


@dataclass(frozen=True)
class Given:
    """The scene, and its surface: `mesh`, or `depths` (one a view, what loads them or None), described by `unit`, which
    is known, or taken to be so, or that nothing says (None); `names` of the views that were named, None where none was;
    `read`: what else was given to be read, by its option."""

    scene: Scene
    mesh: Path | None
    depths: list | None
    unit: str = ""
    unit_is_known: bool | None = False
    where: str = ""       # the depth maps are
    names: list[str] | None = None
    read: dict[str, Path | None] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Format and photos; cameras; depth or mesh, and units."""
        views = self.scene.views
        sizes = sorted({(view.camera.width, view.camera.height) for view in views})
        size = " to ".join("{} x {}".format(*s) for s in dict.fromkeys((sizes[0], sizes[-1])))
        focal = sorted(view.camera.fx for view in views)
        centers = np.array([view.camera.center for view in views])
        some = centers[:: max(1, len(views) // 200)]
        apart = np.linalg.norm(some[:, None] - centers[None], axis=-1)
        apart = np.where(apart > 0, apart, np.inf).min(axis=1)
        near = f", {np.median(apart):.3g} units from each to the next one" if np.isfinite(apart).all() else ""
        if self.mesh is not None:
            surface = f"mesh: {self.mesh}, in the cameras' world"
        elif self.depths is None:
            surface = "no depth and no mesh"
        else:
            count = sum(depth is not None for depth in self.depths)
            every = "of every view" if count == len(self.depths) else f"of {count} of {len(self.depths)} views"
            surface = f"depth: maps {every}, from {self.where}; unit: {self.unit}"
        return [f"photos: {len(views)} of {size}, from {self.scene.source}",
                f"cameras: {len(views)}, focal length {focal[0]:.0f}"
                + (f" to {focal[-1]:.0f}" if focal[-1] - focal[0] > 1 else "") + f" pixels{near}", surface]

    def without(self, hold_out: list[str]) -> "Given":
        """The same without the views `hold_out`, none of which was named."""
        found, views = self.scene, self.scene.views
        out = {found.index(name) for name in hold_out}
        both = sorted({views[place].name for place in out} & set(self.names or ()))
        if both:
            raise InputError(f"view {both[0]!r} is in --views and in --hold-out, expected one of them")
        if out:
            log.info("held out, and seen by nothing: %s", ", ".join(views[place].name for place in sorted(out)))
        if len(out) == len(views):
            raise InputError(f"--hold-out names all {len(out)} views, so that none is left to refine")
        kept = [place for place in range(len(views)) if place not in out]
        before, after = file_stems([view.name for view in views]), file_stems([views[place].name for place in kept])
        for place, stem in zip(kept, after):
            if stem != before[place]:
                log.warning("the depth map of %s is called %s.npz, not %s.npz, while others are held out: keep it "
                            "apart from those of a run with all photos", views[place].name, stem, before[place])
        return replace(self, scene=replace(found, views=[views[place] for place in kept]),
                       depths=self.depths and [self.depths[place] for place in kept])

    def log(self) -> None:
        """Log what was found; InputError where it has no surface."""
        for line in self.lines():
            log.info("%s", line)
        if self.mesh is None and self.depths is None:
            raise InputError(f"{str(self.read['SCENE'])!r} holds neither depth maps nor a mesh: give --mesh or "
                             "--depth-dir")

    def file_stems(self) -> list[str]:
        """What the files of its views are called; InputError for names that no file can have, and for photos and masks
        that are missing, unreadable, cut off or of another size."""
        for view in self.scene.views:
            view.check_files(whole=True)
        return file_stems([view.name for view in self.scene.views])

    @property
    def requested(self) -> list[int]:
        """Places of the views that were named, of all where none was."""
        return [k for k, view in enumerate(self.scene.views) if self.names is None or view.name in self.names]

    @property
    def inputs(self) -> dict[str, Path | None]:
        """What is read, by names for `check_outputs`."""
        return {**self.read, "the mesh of SCENE": self.mesh, **scene_inputs(self.scene, self.depths)}

    def initial_depths(self, progress: Progress, device: Device | None = None) -> list:
        """The depth map of every view, None where a view has none; of a mesh drawn on `device`."""
        if self.mesh is None:
            return loaded(together(self, align=False))
        from pagas_cl import refine

        return refine.initial_depths(to_surface(self.mesh), self.scene.views, progress, device=device)

    def with_truth(self, place: Path, depth_scale: float | None) -> "Given":
        """The same scene with the mesh, or the folder of depth maps, of --truth, whose unit has to be known."""
        given = (_from_folder(self.scene, place, depth_scale, "--truth") if place.is_dir()
                 else Given(self.scene, place, None))
        if given.unit_is_known is None:
            raise InputError(f"depth maps in {given.where!r} are PNG files, which do not say their unit: {_GIVE_UNIT}")
        return given


def load_scene(scene: Path, format: str | None, outside: bool, photos: Path | None = None) -> Scene:
    """The scene in a folder; options that its reader does not have are refused by name."""
    options = {**({"outside": True} if outside else {}), **({} if photos is None else {"photos": photos})}
    try:
        return read_scene(scene, format, **options)
    except TypeError as error:
        option = next((name for name in options if f"'{name}'" in str(error)), None)
        if option is None:
            raise
        raise InputError(f"--{option} does not go with the format of {str(scene)!r}") from error


def loaded(depths) -> list:
    """The depth maps themselves, for what loads them."""
    return [None if depth is None else depth_array(depth) for depth in depths]


def look(scene: Path, *, mesh: Path | None = None, depth_dir: Path | None = None, depth_scale: float | None = None,
         format: str | None = None, outside: bool = False, photos: Path | None = None, names=()) -> Given:
    """Read the scene, and find its surface where neither a mesh nor a folder of depth maps is named.

    Looked for: depth maps that the format has, depth maps in the usual folders, a mesh that the format names, one mesh
    in the folder; what earlier runs have written there last, so that the same command begins where it did before.
    """
    if mesh is not None and depth_dir is not None:
        raise InputError("expected either --mesh or --depth-dir, got both")
    if depth_dir is not None and not depth_dir.is_dir():
        raise InputError(f"--depth-dir {str(depth_dir)!r} is no folder")
    found = load_scene(scene, format, outside, photos)
    names = list(dict.fromkeys(found.views[found.index(name)].name for name in names)) or None
    read = {"SCENE": scene, "--mesh": mesh, "--depth-dir": depth_dir, "--photos": photos}
    if mesh is None and depth_dir is None and found.depths is None:
        written = {folder: work_folder(folder).is_dir() for folder in (scene / name for name in DEPTH_FOLDERS)
                   if any(find_depth(folder, view.name) for view in found.views)}
        depth_dir = next((folder for folder, by_a_run in written.items() if not by_a_run), None)
        mesh = found.mesh or _mesh_in(scene) if depth_dir is None else None
        if mesh is None and depth_dir is None:
            depth_dir = next(iter(written), None)
    if mesh is not None:
        if depth_scale is not None:
            raise InputError(f"--depth-scale is the unit of depth maps, and the surface is the mesh {str(mesh)!r}")
        read_content(mesh, outside=outside)
        given = Given(found, mesh, None)
    elif depth_dir is not None:
        given = _from_folder(found, depth_dir, depth_scale, "--depth-dir")
        _check_refined(given, names)
    elif found.depths is not None and depth_scale is not None:
        depths = [depth and replace(depth, scale=depth_scale) for depth in found.depths]
        given = Given(found, None, depths, _as_you_say(depth_scale), True, found.source)
    else:
        given = Given(found, None, found.depths, found.depth_unit, where=found.source)
    return replace(given, names=names, read=read)


def _as_you_say(depth_scale: float) -> str:
    return f"{depth_scale:g} for one scene unit, as you say"


def _check_refined(given: Given, names) -> None:
    """InputError where one of the views `names` has no depth map in --depth-dir; of all views those are named."""
    views = given.scene.views
    without = [view for view, depth in zip(views, given.depths) if depth is None]
    requested = [view for view in without if names and view.name in names]
    if requested:
        stem = file_stems([view.name for view in views])[views.index(requested[0])]
        raise InputError(f"--depth-dir {given.where!r} holds no depth map of the view {requested[0].name!r}, which"
                         f" is to be refined, expected for instance {stem}.npz")
    if without and not names:
        log.warning("%d views have no depth map in %s: they help to refine others, but are not refined: %s",
                    len(without), given.where,
                    ", ".join(view.name for view in without[:10]) + (", ..." if len(without) > 10 else ""))


def _from_folder(found, folder: Path, depth_scale: float | None, option: str) -> Given:
    """Depth maps called as the photos are, None for a view without a file; `option` has named the folder."""
    called = [view.name for view in found.views]
    files = find_depths(folder, called)
    if not any(files):
        there = next((f", not only {short(path.name)}" for path in sorted(folder.glob("[!.]*"))), "")
        raise InputError(f"{option} {str(folder)!r} holds no depth map of the scene's {len(files)} views, expected for "
                         f"instance {file_stems(called)[0]}{DEPTH_SUFFIXES[0]} (or {', '.join(DEPTH_SUFFIXES[1:])})"
                         f"{there}")
    unit, known, scale = "as the cameras' positions", False, 1.0
    if depth_scale is not None:
        unit, known, scale = _as_you_say(depth_scale), True, depth_scale
    elif any(file and file.suffix.lower() == ".png" for file in files):
        unit, known = "not said by PNG files", None
    sources = [file and of_photo(file.resolve(), view.image, view.camera, scale)
               for view, file in zip(found.views, files)]
    bent = sum(source is not None and source.through is not None for source in sources)
    if bent:
        log.info("%d depth maps in %s are of distorted photos, as they are taken, and are undistorted with them", bent,
                 folder)
    return Given(found, None, sources, unit, known, str(folder))


def _mesh_in(folder: Path) -> Path | None:
    """The mesh in the folder, one by pagas_cl only where there is no other; a .ply without faces is none."""
    files = sorted(folder.glob("[!.]*")) if folder.is_dir() else []
    found = [path for path in files if path.suffix.lower() in SUFFIXES and path.is_file()
             and (path.suffix.lower() != ".ply" or _has_faces(path))]
    found = [path for path in found if not is_own_mesh(path)] or found
    if len(found) > 1:
        raise InputError(f"{str(folder)!r} holds several meshes ({', '.join(path.name for path in found[:5])}): name "
                         "one with --mesh")
    return found[0] if found else None


def _has_faces(path: Path) -> bool:
    return any(name == "face" and count for name, count, _ in read_header(path).elements)


def together(given: Given, align: bool) -> list:
    """The depth maps, aligned in scale where they are not and `align` allows it; what was done is logged."""
    depths, unknown = given.depths or [], given.unit_is_known is None
    if not align and not unknown:
        return depths
    result = align_depth_scales(given.scene.views, depths, bool(given.unit_is_known))
    for sentence in result.said:
        log.warning("%s", sentence)
    if unknown and result.unit == 1 and not result.agreement >= 0.5:
        raise InputError(f"depth maps in {given.where!r} are PNG files, which do not say their unit, and photos do not "
                         f"show it; {_GIVE_UNIT}")
    return result.apply(depths)


def place_of(device, devices, scheduler) -> dict:
    """Where the work is done, as refine_views takes it."""
    if device is not None and devices is not None:
        raise InputError("got both --device and --devices, expected one of them")
    several = "all" if devices == "all" else devices.split(",") if devices else None
    if scheduler is not None:
        check_address(scheduler)
        return {"executor": scheduler, "device": several or device}
    return {"device": several or opened_device(device)}
