"""Writers of other programs' formats, under the name by which tests know them: those of the package, and one that only
tests want."""

import json

from pagas_cl.synthetic.exports import bundler, mvsnet, nerfstudio, neus, open3d_log

__all__ = ["bundler", "mvsnet", "nerfstudio", "neus", "open3d_json", "open3d_log"]


def open3d_json(path, cameras) -> None:
    """A PinholeCameraTrajectory of Open3D, which counts pixel centres at whole numbers."""
    entries = []
    for camera in cameras:
        K = camera.K
        K[:2, 2] -= 0.5
        entries.append({"class_name": "PinholeCameraParameters", "version_major": 1, "version_minor": 0,
                        "extrinsic": camera.world_to_camera.T.ravel().tolist(),
                        "intrinsic": {"width": camera.width, "height": camera.height,
                                      "intrinsic_matrix": K.T.ravel().tolist()}})
    data = {"class_name": "PinholeCameraTrajectory", "version_major": 1, "version_minor": 0, "parameters": entries}
    path.write_text(json.dumps(data, indent=1))
