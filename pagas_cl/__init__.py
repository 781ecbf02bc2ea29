"""Refine a coarse mesh or depth maps with calibrated photos: PAGaS in OpenCL, for Open3D and pymeshlab.

The public names below are imported when they are first used: `import pagas_cl` alone loads no pyopencl, open3d or
pymeshlab and does no work.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

_HOME = {
    "Camera": "pagas_cl.scene.camera",
    "View": "pagas_cl.scene.view",
    "Scene": "pagas_cl.scene.view",
    "Surface": "pagas_cl.scene.mesh",
    "read_scene": "pagas_cl.scene.readers",
    "Config": "pagas_cl.config",
    "preset": "pagas_cl.presets",
    "refine_mesh": "pagas_cl.refine",
    "refine_depth": "pagas_cl.refine",
    "tradeoff": "pagas_cl.tradeoffs",
    "check_cameras": "pagas_cl.camera_check",
    "PagasError": "pagas_cl.errors",
    "InputError": "pagas_cl.errors",
    "DeviceError": "pagas_cl.errors",
    "KernelBuildError": "pagas_cl.errors",
    "MissingExtraError": "pagas_cl.errors",
}

__all__ = sorted(_HOME)

try:
    __version__ = version("pagas-cl")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"


def __getattr__(name):
    if name not in _HOME:
        raise AttributeError(f"module 'pagas_cl' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted([*globals(), *__all__])
