"""Refined cameras as a COLMAP model, for other tools."""

import json
import shutil
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, log, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.own_files import is_own_json
from pagas_cl.scene.readers import colmap
from pagas_cl.scene.view import View
from pagas_cl.system.files import read_bytes, replaced, translated

REPORT = "cameras_report.json"      # next to sparse/: what was measured, and the files of the model that were written
_PARTS = ("cameras", "images", "points3D", "rigs", "frames")


def check_place(out: str | Path, views: Sequence[View], overwrite: bool = False) -> None:
    """Before the work: InputError where OUT/sparse/0 has files of a model that pagas_cl has not written (the scene's
    own, say; unless `overwrite`), or a name is none that a COLMAP model can have."""
    place = Path(out) / "sparse" / "0"
    foreign = [] if overwrite else [file for file in _model_files(place) if file.name not in _own_files(Path(out))]
    if foreign or (place.exists() and not place.is_dir()):
        raise InputError(f"--output: {str(foreign[0] if foreign else place)!r} is of a model that pagas_cl has not "
                         "written: choose another folder, or replace it with --overwrite")
    for view in views:
        try:
            view.name.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"view {view.name!r} has a name that is no UTF-8, which a COLMAP model cannot hold: "
                             "rename the photo") from error


def write_model(folder: str | Path, views: Sequence[View], cameras: Sequence[Camera], out: str | Path) -> Path:
    """Write OUT/sparse/0 with `cameras`, one of each of `views`; returns that folder.

    Where `folder`, the scene's, has a COLMAP model, it is that model with other poses, and other focal lengths and
    principal points of pinholes: ids, names, distorted lenses, points and their tracks stay; rigs of several cameras
    become single ones, which is logged. Else a new one, without points.
    """
    pycolmap = need("pycolmap", "colmap", "writing a COLMAP model")
    place, out = colmap.detect(Path(folder)), Path(out) / "sparse" / "0"
    poses = {view.name: camera for view, camera in zip(views, cameras)}
    model = pycolmap.Reconstruction()
    if place is not None:
        given = pycolmap.Reconstruction()
        with translated(f"the COLMAP model of {str(folder)!r} cannot be read: ", "", (RuntimeError, ValueError)):
            given.read(str(place))
        if any(frame.num_data_ids() > 1 for frame in given.frames.values()):
            log.warning("the rigs in %s are written as single cameras: the pose of each photo was refined by itself",
                        place)
        for lens in given.cameras.values():
            model.add_camera_with_trivial_rig(lens)
        for image in given.images.values():
            single = pycolmap.Image(name=image.name, points2D=image.points2D, camera_id=image.camera_id,
                                    image_id=image.image_id)
            camera, lens = poses.get(image.name), model.cameras[image.camera_id]
            model.add_image_with_trivial_frame(single, _pose(pycolmap, camera) if camera else image.cam_from_world())
            if camera and lens.model.name in ("PINHOLE", "SIMPLE_PINHOLE"):     # the last three or all four numbers
                own = camera.resized(lens.width, lens.height)       # its photo may have another size
                lens.params = [own.fx, own.fy, own.cx, own.cy][-len(lens.params):]
        for number, point in given.points3D.items():
            model.add_point3D_with_id(number, point)
    else:
        for number, (view, camera) in enumerate(zip(views, cameras), start=1):
            model.add_camera_with_trivial_rig(pycolmap.Camera(
                camera_id=number, model="PINHOLE", width=camera.width, height=camera.height,
                params=[camera.fx, camera.fy, camera.cx, camera.cy]))
            model.add_image_with_trivial_frame(pycolmap.Image(name=view.name, camera_id=number, image_id=number),
                                               _pose(pycolmap, camera))
    as_text = place is not None and not (place / "cameras.bin").is_file()
    with tempfile.TemporaryDirectory() as folder:
        (model.write_text if as_text else model.write_binary)(folder)
        written = sorted(Path(folder).iterdir())
        for file in written:
            with replaced(out / file.name) as copy:
                shutil.copyfile(file, copy)
    for file in _model_files(out):      # of an earlier model: a .bin would be read in place of a .txt
        if file.name not in [part.name for part in written]:
            file.unlink()
    return out


def _model_files(place: Path) -> list[Path]:
    """Those in a folder that COLMAP reads as a model."""
    return [file for name, suffix in product(_PARTS, (".bin", ".txt")) if (file := place / f"{name}{suffix}").exists()]


def _own_files(out: Path) -> list[str]:
    """Names of the files in OUT/sparse/0 that an earlier run has written."""
    report = out / REPORT
    return json.loads(read_bytes(report)).get("model", []) if is_own_json(report) else []


def _pose(pycolmap, camera: Camera):
    pose = np.ascontiguousarray(camera.world_to_camera[:3])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
