"""Refined cameras as a COLMAP model, for other tools."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError, need
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.files import replaced, translated
from pagas_cl.scene.readers import colmap
from pagas_cl.scene.view import View

REPORT = "cameras_report.json"      # of a model of ours, beside sparse/


def check_place(out: str | Path, views: Sequence[View]) -> None:
    """Before the work: InputError where OUT/sparse/0 is a model of somebody else (the scene's own, say), or a name is
    none that a COLMAP model can have."""
    place = Path(out) / "sparse" / "0"
    if place.exists() and not (place.is_dir() and not any(place.iterdir())) and not (Path(out) / REPORT).is_file():
        raise InputError(f"--output: {str(place)!r} is a model that another program wrote, which would be replaced: "
                         "choose another folder")
    for view in views:
        try:
            view.name.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"view {view.name!r} has a name that is no UTF-8, which a COLMAP model cannot hold: "
                             "rename the photo") from error


def write_model(folder: str | Path, views: Sequence[View], cameras: Sequence[Camera], out: str | Path) -> Path:
    """Write OUT/sparse/0 with `cameras`, one of each of `views`; returns that folder.

    Where `folder`, the scene's, has a COLMAP model, it is that model with other poses: ids, names, lenses, points and
    their tracks stay. Else a new one, without points.
    """
    pycolmap = need("pycolmap", "colmap", "writing a COLMAP model")
    place, out = colmap.detect(Path(folder)), Path(out) / "sparse" / "0"
    poses = {view.name: camera for view, camera in zip(views, cameras)}
    model = pycolmap.Reconstruction()
    if place is not None:
        with translated(f"the COLMAP model of {str(folder)!r} cannot be read: ", "", (RuntimeError, ValueError)):
            model.read(str(place))
        for image in model.images.values():
            if image.name not in poses:
                continue
            if not image.is_ref_in_frame() or image.frame.num_data_ids() > 1:
                raise InputError(f"image {image.name!r} of {str(place)!r} belongs to a rig of several cameras, whose "
                                 "poses hang together; expected one camera a frame")
            image.frame.set_cam_from_world(image.camera_id, _pose(pycolmap, poses[image.name]))
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
        for file in sorted(Path(folder).iterdir()):
            with replaced(out / file.name) as beside:
                shutil.copyfile(file, beside)
    return out


def _pose(pycolmap, camera: Camera):
    pose = np.ascontiguousarray(camera.world_to_camera[:3])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
