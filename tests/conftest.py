"""Fixtures that several test files share."""

from pathlib import Path

import numpy as np
import pytest

from pagas_cl.scene.camera import Camera

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real scenes (too large to ship): beside the checkout."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real scenes are not here: {folder} does not exist")
    return folder


def look_at(center, point, width=160, height=120, focal=140.0, cx=83.3, cy=57.1, name="", up=(0, -1, 0)) -> Camera:
    """A camera at `center` that looks at `point`, with an off-centre principal point."""
    center, point = np.asarray(center, float), np.asarray(point, float)
    forward = (point - center) / np.linalg.norm(point - center)
    right = np.cross(-np.asarray(up, float), forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return Camera(width, height, focal, focal * 1.01, cx, cy, pose, name)


def plane_depth(camera: Camera, normal, offset: float) -> np.ndarray:
    """Exact depth of the plane normal . X = offset at the pixel centres, float32."""
    rotation = camera.world_to_camera[:3, :3]
    slope = camera.rays() @ (rotation @ np.asarray(normal, float))
    return ((offset - np.dot(normal, camera.center)) / slope).astype(np.float32)


@pytest.fixture
def ring() -> list[Camera]:
    """Seven cameras on an arc of 36 degrees, 4 units from the origin, looking at it."""
    angles = np.radians(np.linspace(-18, 18, 7))
    return [look_at((4 * np.sin(a), 0.3 * np.cos(5 * a), -4 * np.cos(a)), (0, 0, 0), name=f"view{i}.png")
            for i, a in enumerate(angles)]


@pytest.fixture(scope="session")
def device():
    """The OpenCL device of the tests; PAGAS_CL_DEVICE chooses another."""
    from pagas_cl.errors import DeviceError
    from pagas_cl.runtime.device import open_device

    try:
        return open_device()
    except DeviceError as error:
        pytest.skip(str(error))
