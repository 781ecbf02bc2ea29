"""MeshLab projects (.mlp): mesh layers with their matrices, raster layers with their cameras. No OpenGL, no pymeshlab.

Convention of the file: camera with x right, y up, looking along -z; RotationMatrix = diag(1, -1, -1) R, and
TranslationVector = minus the camera's centre; the focal length in pixels is FocalMm / PixelSizeMm; CenterPx counts x
from the left and y from the BOTTOM, from the image's corner (pixel centres at +0.5). OpenMVS writes the same element
with CenterPx from the top and pixel centres at whole numbers: flavour "openmvs".
"""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from pagas_cl.errors import InputError, MissingExtraError, as_path, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.camera import FLIP, Camera, intrinsics
from pagas_cl.scene.check import patches
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.files import read_content
from pagas_cl.scene.own_files import TEXT_MARK, is_own_mesh
from pagas_cl.scene.readers import photos
from pagas_cl.scene.view import Scene, View, checked_views, listed
from pagas_cl.system.files import write_text

EXPECTED = ".mlp file"
FLAVOURS = ("meshlab", "openmvs")
_SAME = 1.0   # pixels: readings nearer than this need no decision
_VIEWS = 8    # whose photos decide it
# of a VCGCamera: attribute, how many numbers, what it is where it is left out
_NUMBERS = (("FocalMm", 1, None), ("PixelSizeMm", 2, None), ("CenterPx", 2, None), ("ViewportPx", 2, None),
            ("LensDistortion", 2, "0 0"), ("RotationMatrix", 16, None), ("TranslationVector", 4, None))


@dataclass(frozen=True, eq=False)
class MeshLayer:
    """A mesh layer: `matrix` (4, 4) takes the file's vertices to the project's world."""

    label: str
    path: Path | None
    matrix: np.ndarray = field(repr=False)
    visible: bool = True


@dataclass(frozen=True, eq=False)
class RasterLayer:
    """A raster layer: its camera as MeshLab reads it, and `center`, CenterPx as the file has it."""

    label: str
    path: Path
    of_meshlab: Camera
    center: tuple[float, float]

    def camera(self, flavour: str = "meshlab") -> Camera:
        """The camera, with CenterPx read as `flavour` says."""
        if flavour not in FLAVOURS:
            raise InputError(f"mlp flavour is {flavour!r}, expected {' or '.join(map(repr, FLAVOURS))}")
        cx, cy = self.center
        return self.of_meshlab if flavour == "meshlab" else replace(self.of_meshlab, cx=cx + 0.5, cy=cy + 0.5)


@dataclass(frozen=True, eq=False)
class Project:
    """A MeshLab project."""

    path: Path
    meshes: tuple[MeshLayer, ...]
    rasters: tuple[RasterLayer, ...]

    def scene(self, flavour: str = "meshlab") -> Scene:
        """Views of all raster layers; masks are looked for in masks/ next to the project."""
        if not self.rasters:
            raise InputError(f"{self.path} has no raster layers with cameras; add the photos in MeshLab "
                             "(Import Raster, with a camera each)")
        for raster in self.rasters:
            photos.existing(raster.path, f"{self.path}, raster layer {short(raster.label)}")
        names = [raster.path.name for raster in self.rasters]
        if len(set(names)) < len(names):      # photos of several folders
            names = [raster.label for raster in self.rasters]
        if len(set(names)) < len(names):
            names = [Path(os.path.relpath(raster.path, self.path.parent)).as_posix() for raster in self.rasters]
        views = [photos.view_of(self.path.parent, replace(raster.camera(flavour), name=name), raster.path, None, name)
                 for name, raster in zip(names, self.rasters)]
        return Scene(views=views, source=f"{self.path} (MeshLab project, {flavour})")

    def mesh_file(self) -> Path | None:
        """The file of the only visible mesh layer, of those that pagas_cl has not written where there are others."""
        shown = [(layer, path) for layer in self.meshes
                 if layer.visible and (path := layer.path) is not None and path.is_file()]
        shown = [one for one in shown if not is_own_mesh(one[1])] or shown
        if len(shown) != 1:
            if shown:
                log.info("%s: none of its %d visible mesh layers is taken as the surface: hide all but one in MeshLab, "
                         "or say which by --mesh", self.path, len(shown))
            return None
        (layer, path), = shown
        if not np.array_equal(layer.matrix, np.eye(4)):
            log.info("%s: mesh layer %s is not taken as the surface, since a matrix moves it: freeze that in MeshLab",
                     self.path, short(layer.label))
            return None
        return path


def detect(folder: Path) -> list[Path]:
    """The .mlp files of `folder`, which may be one itself; hidden files left out."""
    return [folder] if folder.is_file() and folder.suffix.lower() == ".mlp" else sorted(folder.glob("[!.]*.mlp"))


def read(folder: Path, files: list[Path], *, flavour: str | None = None, outside: bool = False) -> Scene:
    """Read the views of the only one of `files`.

    Without `flavour` the reading of CenterPx is resolved by the photos (`resolve_flavour`), and logged.
    """
    if len(files) != 1:
        raise InputError(f"{folder} has {len(files)} .mlp files, expected one; name the one to read")
    project = read_project(files[0], outside=outside)
    if flavour is None:
        flavour, reason = resolve_flavour(project)
        log.info("%s", reason)
    return replace(project.scene(flavour), mesh=project.mesh_file())


def read_project(path: Path, *, outside: bool = False) -> Project:
    """Read a .mlp file; `outside`: whether meshes and photos may lie outside its folder, where relative paths start."""
    path = Path(path)
    root = untrusted.read_xml(path, "MeshLabProject")
    meshes = [_mesh(e, path, i, outside) for i, e in enumerate(root.findall("MeshGroup/MLMesh"))]
    rasters = [_raster(e, path, i, outside) for i, e in enumerate(root.findall("RasterGroup/MLRaster"))]
    misplaced = len(list(root.iter("VCGCamera"))) - len(rasters) - len(root.findall("MeshGroup/MLMesh/VCGCamera"))
    if misplaced:
        raise InputError(f"{path} has {misplaced} cameras outside its raster layers: is the file damaged?")
    photos.warn_of_rounding([camera.get("TranslationVector", "") for camera in
                             root.iterfind("RasterGroup/MLRaster/VCGCamera")], path)
    return Project(path, tuple(meshes), tuple(rasters))


def _mesh(element: Element, path: Path, number: int, outside: bool) -> MeshLayer:
    where, name = f"{path}, mesh layer {number}", element.get("filename", "")
    stored, matrix = element.find("MLMatrix44"), np.eye(4)
    if stored is not None:
        _refuse_binary(stored, f"{where}: the matrix")
        matrix = untrusted.floats(stored.text, f"{where}: MLMatrix44", 16).reshape(4, 4)
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9 or abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise InputError(f"{where}: MLMatrix44 is no affine transform that can be undone")
    file = untrusted.inside(path.parent, name, f"{where}: filename", outside=outside) if name else None
    return MeshLayer(element.get("label", name), file, matrix, element.get("visible", "1") != "0")


def _refuse_binary(element: Element, what: str) -> None:
    if element.get("BinaryData", "0") != "0":
        raise InputError(f"{what} is stored as binary; save the project as .mlp, not .mlb")


def _raster(element: Element, path: Path, number: int, outside: bool) -> RasterLayer:
    where = f"{path}, raster layer {number} ({short(element.get('label', ''))})"
    camera = element.find("VCGCamera")
    if camera is None:
        raise InputError(f"{where} has no VCGCamera")
    _refuse_binary(camera, f"{where}: the camera")
    if camera.get("CameraType", "0") != "0":
        raise InputError(f"{where}: CameraType is {short(camera.get('CameraType'))}, expected 0 (perspective)")
    get = {key: untrusted.floats(camera.get(key, left_out), f"{where}: {key}", count)
           for key, count, left_out in _NUMBERS}
    if get["LensDistortion"].any():
        raise InputError(f"{where}: LensDistortion is {short(camera.get('LensDistortion'))}, expected 0 0: "
                         "photos must be undistorted first")
    if (get["PixelSizeMm"] <= 0).any():
        raise InputError(f"{where}: PixelSizeMm is {get['PixelSizeMm'].tolist()}, expected numbers above 0")
    across, down = get["ViewportPx"].tolist()
    width, height = untrusted.size(across, down, f"{where}: ViewportPx")
    with np.errstate(over="ignore"):
        fx, fy = (get["FocalMm"][0] / get["PixelSizeMm"]).tolist()
    cx, cy = get["CenterPx"].tolist()
    plane = element.find("Plane")
    name = plane.get("fileName") if plane is not None else None
    file = untrusted.inside(path.parent, name, f"{where}: fileName of its Plane", outside=outside)
    rotation, translation = get["RotationMatrix"].reshape(4, 4), get["TranslationVector"]
    if np.abs(np.r_[rotation[3] - [0, 0, 0, 1], rotation[:3, 3], translation[3] - 1]).max() > 1e-9:
        raise InputError(f"{where}: RotationMatrix or TranslationVector is not of the form that MeshLab writes")
    R = FLIP[:3, :3] @ rotation[:3, :3]
    pose = np.column_stack([R, R @ translation[:3]])
    read = untrusted.pinhole(intrinsics(fx, fy, cx, height - cy), pose, width, height, file.name)
    return RasterLayer(element.get("label", ""), file, read, (cx, cy))


def resolve_flavour(project: Project) -> tuple[str, str]:
    """Which way CenterPx.y is counted, one of FLAVOURS, and one sentence that says why.

    Patches of its mesh are correlated between pairs of photos; MeshLab's reading is taken unless they prefer the other.
    """
    apart = max((abs(raster.of_meshlab.height - 2 * raster.center[1] - 0.5) for raster in project.rasters), default=0.0)
    what = f"{project.path}: CenterPx.y"
    if apart < _SAME:
        return "meshlab", f"{what} reads the same from the top and from the bottom (within {_SAME:g} pixel)"
    undecided = f"{what} was read from the bottom, as MeshLab writes it, {apart:.4g} pixels from the other reading"
    scores, reason = dict[str, np.ndarray](), "too few textured patches are seen by two views"
    try:
        scores = _scores(project)
    except (InputError, MissingExtraError) as error:
        reason = str(error)
    if not scores:
        return "meshlab", f"{undecided}; photos could not decide it ({reason})"
    medians = [float(np.nanmedian(scores[f])) for f in FLAVOURS]
    agreement = f"(correlation {medians[0]:.2f} from the bottom, {medians[1]:.2f} from the top)"
    if patches.prefers(scores["openmvs"], scores["meshlab"]):
        return "openmvs", (f"{what} was read from the TOP, as OpenMVS writes it: the photos prefer it {agreement}; "
                           "pass flavour='meshlab' if that is wrong")
    if patches.prefers(scores["meshlab"], scores["openmvs"]):
        return "meshlab", f"{what} was read from the bottom, as MeshLab writes it; the photos agree {agreement}"
    return "meshlab", (f"{undecided}; the photos prefer neither {agreement}: pass flavour='openmvs' if OpenMVS wrote "
                       "the file")


def _surface(project: Project) -> Surface:
    """The first visible mesh layer in the project's world; a point cloud is none."""
    for layer in project.meshes:
        if layer.visible and layer.path is not None:
            content = read_content(layer.path)
            if len(content.faces):
                return Surface(content.vertices @ layer.matrix[:3, :3].T + layer.matrix[:3, 3], content.faces)
    raise InputError("the project has no mesh layer with a file of triangles")


def _scores(project: Project) -> dict[str, np.ndarray]:
    """Of each flavour correlations of patches between the same pairs of views; empty where too few can be compared."""
    surface, views = _surface(project), project.scene().views
    cameras = {flavour: [raster.camera(flavour) for raster in project.rasters] for flavour in FLAVOURS}
    for keep in patches.groups(cameras["meshlab"], _VIEWS):
        some = {flavour: [cameras[flavour][k] for k in keep] for flavour in FLAVOURS}
        greys = [patches.grey_of(views[k].load_image()) for k in keep]
        samples = patches.sample_surface(surface, seen_by=some["meshlab"])
        seen, pairs = patches.overlaps(some["meshlab"], samples)
        scores = {f: patches.patch_correlation(some[f], greys, pairs, seen, samples) for f in FLAVOURS}
        if min(np.isfinite(score).sum() for score in scores.values()) >= patches.LEAST:
            return scores
    return {}


def check_names(views: Sequence[View]) -> None:
    """InputError where the name of a view, or of its photo, cannot stand in a project, which is XML."""
    for view in views:
        if re.search("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", f"{view.name}{photos.file_of(view) or ''}"):
            raise InputError(f"view {view.name!r} has characters in its name, or its photo's, that cannot stand in a "
                             "MeshLab project: rename the photo")


def write_project(path: Path, views: list[View], meshes: Sequence[MeshLayer] = ()) -> Path:
    """Write a .mlp that MeshLab opens; every camera keeps all its digits (MeshLab itself keeps six).

    Photos and meshes are named relative to the project where they lie next to or below it, else by absolute path.
    """
    views, path = checked_views("views", views), as_path("path", path)
    check_names(views)
    meshes = listed("meshes", meshes, "a list of MeshLayer", MeshLayer)
    root = Element("MeshLabProject")
    layers, rasters = SubElement(root, "MeshGroup"), SubElement(root, "RasterGroup")
    for layer in meshes:
        element = SubElement(layers, "MLMesh", label=layer.label, filename=_name(path, layer.path),
                             visible=str(int(layer.visible)), idInFile="-1")
        SubElement(element, "MLMatrix44").text = "\n".join(["", *map(row, np.asarray(layer.matrix, np.float64)), ""])
    for view in views:
        element = SubElement(rasters, "MLRaster", label=view.name)
        SubElement(element, "VCGCamera", _camera(view.camera))
        SubElement(element, "Plane", semantic="1", fileName=_name(path, photos.file_of(view)))
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    return write_text(path, f"<!DOCTYPE MeshLabDocument>\n<!-- {TEXT_MARK} -->\n{text}\n")


def _camera(camera: Camera) -> dict[str, str]:
    rotation = np.eye(4)
    rotation[:3, :3] = FLIP[:3, :3] @ camera.world_to_camera[:3, :3]
    values: dict[str, Iterable[float]] = {
        "FocalMm": [camera.fx], "PixelSizeMm": [1.0, camera.fx / camera.fy],
        "CenterPx": [camera.cx, camera.height - camera.cy], "LensDistortion": [0.0, 0.0],
        "RotationMatrix": rotation.ravel(), "TranslationVector": [*(-camera.center), 1.0]}
    return {"CameraType": "0", "BinaryData": "0", "ViewportPx": f"{camera.width} {camera.height}",
            **{key: row(value) for key, value in values.items()}}


def row(values: Iterable[float]) -> str:
    """Numbers of a text file, every digit."""
    return " ".join(repr(float(value)) for value in values)


def _name(path: Path, file: Path | None) -> str:
    if file is None:
        return ""
    file, root = file.absolute(), path.absolute().parent
    return (file.relative_to(root) if file.is_relative_to(root) else file).as_posix()
