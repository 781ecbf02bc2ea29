"""Fixtures that several test files share, and what the choices of tests `make quick` and `make kernels` mean."""

import contextlib
import gc
import importlib
import os
import re
import sys
import tempfile
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:      # several at a time: threads that wait for one another's cores burn them
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np

from pagas_cl.scene.camera import Camera

ROOT = Path(__file__).resolve().parents[1]
sys.dont_write_bytecode = False      # what one process has compiled the others read: workers, and every child of a test
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.setdefault("PAGAS_CL_TRIAL", "known")     # whoever edits a kernel hears from its test, not from the trial
if "PYTEST_XDIST_WORKER" in os.environ:      # `make test` runs two at a time: each its own locks of devices
    os.environ["TMPDIR"] = tempfile.tempdir = tempfile.mkdtemp(prefix="pagas_cl-tests-")

HEAVY = ("open3d", "pymeshlab", "pycolmap", "dask", "distributed", "scipy", "matplotlib")


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: left out by `make quick`; a file, or a test in a fast file")
    config.addinivalue_line("markers", "kernels: what another build of the kernels can change; `make kernels` takes "
                                       "these, on any device")
    if config.option.markexpr == "not slow":      # the fast tier is that of a minimal install: what needs these skips
        sys.modules.update(dict.fromkeys(HEAVY))


def pytest_ignore_collect(collection_path, config):
    """Leave out files of which the choice takes nothing: importing them takes time."""
    chosen = config.option.markexpr
    if collection_path.suffix != ".py" or chosen not in ("not slow", "kernels"):
        return None
    marks = re.findall(r"^(pytestmark = .*|@pytest\.mark\.kernels)", collection_path.read_text(), re.MULTILINE)
    if chosen == "kernels":
        return True if not any("kernels" in line for line in marks) else None
    return True if any("mark.slow" in line for line in marks) else None


def pytest_collection(session):
    """Each worker takes the test files from another place on: what one has compiled by then, the others only read."""
    number, workers = (os.environ.get(f"PYTEST_XDIST_WORKER{end}", "") for end in ("", "_COUNT"))
    if not number:
        return
    folders = [path for path in map(Path, session.config.args) if path.is_dir()]
    files = sorted(path for folder in folders for path in folder.rglob("test_*.py")
                   if not pytest_ignore_collect(path, session.config))
    for path in files[int(number[2:])::int(workers)]:
        if str(path.parent) not in sys.path:
            sys.path.append(str(path.parent))
        with contextlib.suppress(pytest.skip.Exception):      # of a whole file: it is told when pytest imports it
            importlib.import_module(path.stem)


def pytest_collection_finish():
    """What collecting has made lives to the end: no collection of garbage need look at it again."""
    gc.collect()
    gc.freeze()


# Begun side by side by three workers: the first compiles what refining takes while the others compile nothing, so that
# nobody compiles it a second time.
FIRST = ["test_acceptance.py", "test_reference.py", "test_align_depth_scales.py"]


def pytest_collection_modifyitems(items):
    """Slow files first: short ones at the end keep all workers busy until it."""
    items.sort(key=lambda item: (FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST),
                                 item.get_closest_marker("slow") is None))


@pytest.fixture(autouse=True, scope="session")
def brief_probes():
    """What settings take is probed by short runs: no test asks more of the time, and a probe takes ten seconds."""
    from pagas_cl.app.tradeoffs import costs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(costs, "_LEAST", 0.03)
        patch.setattr(costs, "_REPEATS", 2)
        yield


@pytest.fixture
def own_locks(tmp_path, monkeypatch):
    """Claims of devices apart from those of other programs on this machine."""
    (tmp_path / "locks").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "locks"))
    monkeypatch.setattr("tempfile.tempdir", None)


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
