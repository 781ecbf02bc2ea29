"""Writers of other programs' camera files, under the name by which tests know them."""

import json

from support.exports import bundler, mvsnet, nerfstudio, neus, open3d_json

from pagas_cl.errors import InputError
from pagas_cl.scene.camera import inverse_pose
from pagas_cl.scene.readers.meshlab import row

__all__ = ["bundler", "mvsnet", "nerfstudio", "neus", "open3d_json", "open3d_log"]


def open3d_log(path, cameras) -> None:
    """A .log trajectory of Open3D, and the intrinsics, which it cannot hold, as camera_intrinsic.json beside it."""
    entries = []
    for camera in cameras:
        K = camera.K
        K[:2, 2] -= 0.5      # pixel centres at whole numbers
        entries.append({"width": camera.width, "height": camera.height, "intrinsic_matrix": K.T.ravel().tolist()})
    if any(entry != entries[0] for entry in entries):
        raise InputError(f"{path}: a .log has one set of intrinsics for all its {len(entries)} cameras, and these "
                         "differ; write a .json")
    rows = []
    for number, camera in enumerate(cameras):
        rows += [f"{number} {number} {number + 1}", *(row(line) for line in inverse_pose(camera.world_to_camera))]
    path.with_name("camera_intrinsic.json").write_text(json.dumps(entries[0], indent=1))
    path.write_text("\n".join(rows) + "\n")
