"""Scenes of other programs: one small module a format (what shares a form, networks, phones, data sets: one object
each), with

`EXPECTED`: in words, what `detect` looks for.
`detect(folder)` looks at names of files, cheaply, and gives the file or folder where the format is, else a false value.
`read(folder, found, **options)`, with what `detect` has found, gives the Scene: cameras in the convention of
scene.camera, photos, and masks.
The module's first lines say the format's own convention; only the module converts. Scenes are foreign files:
numbers, texts, paths and cameras go through `scene.untrusted`, arrays through `system.files`; what is damaged,
distorted or unclear ends in one InputError sentence. A new format is a new module and a line in FORMATS.
"""

import re
from os.path import isfile
from pathlib import Path
from typing import Any

from pagas_cl.errors import InputError, as_path, log, short
from pagas_cl.scene import untrusted
from pagas_cl.scene.readers import (
    bundler,
    camera_file,
    colmap,
    meshlab,
    mvsnet,
    nerfstudio,
    networks,
    neus,
    open3d_trajectory,
    phones,
    photos,
    recordings,
)
from pagas_cl.scene.view import Scene, file_behind

# In the order of looking: what names its convention and its photos itself comes first. Each has what is said above.
FORMATS: dict[str, Any] = {
    "cameras": camera_file, "colmap": colmap, "nerfstudio": nerfstudio, "mvsnet": mvsnet, "neus": neus,
    "open3d": open3d_trajectory, "bundler": bundler, "meshlab": meshlab, "da3": networks.DEPTH_ANYTHING,
    "vggt": networks.VGGT, "mapanything": networks.MAP_ANYTHING, "record3d": phones.RECORD3D, "polycam": phones.POLYCAM,
    "scannet": recordings.SCANNET, "7scenes": recordings.SEVEN_SCENES, "tum": recordings.TUM,
    "dvmvs": recordings.VIDEO_MVS}


def read_scene(folder: str | Path, format: str | None = None, **options: Any) -> Scene:
    """Read the scene in `folder`.

    `format` is one of FORMATS, found by looking at the folder where it is left out; `options` go to its `read`.
    InputError where the folder does not exist, holds no known format, or its content cannot be used.
    """
    folder = as_path("folder", folder)
    if not folder.exists():
        raise InputError(f"scene {str(folder)!r} does not exist")
    folder = folder.absolute()      # workers of a cluster may be at work in other folders
    if format is not None and not (isinstance(format, str) and format in FORMATS):
        raise InputError(f"unknown format {short(format)}, expected one of {', '.join(FORMATS)}")
    for name in FORMATS if format is None else [format]:
        found = FORMATS[name].detect(folder)
        if found:
            scene: Scene = FORMATS[name].read(folder, found, **options)
            photos.refuse_shared_masks(scene.views, folder)
            photos.check_masks(scene.views, folder / "masks")
            photos.warn_of_links(scene.files, folder)
            photos.warn_of_unused([path for view in scene.views if (path := file_behind(view.image)) is not None])
            of_depth = list(FORMATS)[list(FORMATS).index("da3"):]
            for other in of_depth if format is None and scene.depths is None else ():
                if other != name and FORMATS[other].detect(folder):
                    log.info("%s is read as %s; it also holds %s, with depth maps: --format %s takes those", folder,
                             name, other, other)
            return scene
    if format is not None:
        raise InputError(f"scene {str(folder)!r} has no {FORMATS[format].EXPECTED}")
    raise InputError(f"scene {str(folder)!r} holds no cameras in a supported format ({', '.join(FORMATS)}); "
                     + ("give the folder that this file is in" if folder.is_file() else
                        "expected for instance images/ and a COLMAP model in sparse/0"
                        + (_model_inside(folder) or _left_by_others(folder))))


def _model_inside(folder: Path) -> str:
    """Where folders in `folder` hold a COLMAP model, such as dense/sparse or sparse/1: how to read it; else ""."""
    inner = next((path for deep in ("*/", "*/*/") for path in sorted(folder.glob(deep)) if colmap.detect(path)), None)
    return "" if inner is None else f"; {str(inner)!r} has one: give that folder, with --photos if it has no images/"


# DUSt3R and MASt3R keep what they found in memory; their demonstrations write scene.glb, people arrays of these names
_DUST3R_ARRAYS = {"pts3d", "depthmaps", "im_poses", "cams2world", "focals"}
_DUST3R = ("; it seems to hold what DUSt3R or MASt3R found: save its depth maps (photos, height, width) as depth, the "
           "inverses of its poses (photos, 3, 4) as extrinsic, its intrinsics (photos, 3, 3) as intrinsic, and its "
           "images (photos, height, width, 3) as images, all in predictions.npz, with the photos in images/")
# Files by which the folder of another program is known, whose cameras are not read, and what to do there
_OTHERS = {
    "scene.glb": _DUST3R,
    "dataparser_transforms.json": "; it is an output of nerfstudio: give the folder that it was trained on, and "
                                  "as --mesh one in the world of transforms.json, which that of ns-export is not in",
    "*.mvs": "; OpenMVS's .mvs is not read: give the COLMAP model that it was made from, and --mesh",
    "*.xml": "; Metashape's .xml is not read: its File > Export > Export Cameras writes COLMAP's models (*.txt), too",
    "sfm_data.*": "; OpenMVG's sfm_data is not read: openMVG_main_openMVG2Colmap makes a COLMAP model of it",
    "reconstruction.json": "; OpenSfM's reconstruction is not read: opensfm export_colmap makes a COLMAP model of it",
    "*.sfm": "; Meshroom's .sfm is not read: its node ExportColmap makes a COLMAP model of it"}


def _left_by_others(folder: Path) -> str:
    """What to do with the folder of a program whose cameras are not read; else ""."""
    arrays = set(networks.arrays_of(folder)).union(*(networks.arrays_of(path) for path in folder.glob("*.npz")))
    if arrays & _DUST3R_ARRAYS:
        return _DUST3R
    if isfile(folder / "cfg_args"):
        return _left_by_splatting(folder)
    return next((what for name, what in _OTHERS.items() if any(folder.glob(name))), "")


def _left_by_splatting(folder: Path) -> str:
    """The same of an output of 3DGS, 2DGS, PGSR and their like: its cameras.json has no principal points."""
    source = re.search("source_path='([^']{1,1000})'", untrusted.read_text(folder / "cfg_args"))
    meshes = [str(path) for place in ("train/*/*_post.ply", "mesh/*_post.ply") for path in folder.glob(place)]
    return ("; it is an output of Gaussian splatting: give the folder that it was trained on"
            + (f", {source[1]!r}," if source else "") + " and as --mesh "
            + (repr(max(meshes, key=lambda path: (len(path), path))) if meshes else     # of the last iteration
               "the one that render.py of 2DGS or PGSR makes (3DGS makes none: its point_cloud.ply holds no surface)"))
