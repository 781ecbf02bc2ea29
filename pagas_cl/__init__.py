"""Refine a coarse mesh or depth maps with calibrated photos: PAGaS in OpenCL, for Open3D and pymeshlab.

The public names below are imported when they are first used: `import pagas_cl` alone loads no pyopencl, open3d or
pymeshlab and does no work. Editors and type checkers read them from the imports under TYPE_CHECKING.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pagas_cl.config.version import __version__ as __version__

if TYPE_CHECKING:
    from pagas_cl.app.tradeoffs import tradeoff
    from pagas_cl.config import Config
    from pagas_cl.config.presets import preset
    from pagas_cl.errors import DeviceError, InputError, KernelBuildError, MissingExtraError, PagasError
    from pagas_cl.method.cameras.refine import CameraRefinement
    from pagas_cl.method.surface.align_depth_scales import DepthScales, align_depth_scales
    from pagas_cl.method.view.one_view import refine_depth
    from pagas_cl.refine import refine_cameras, refine_mesh, refine_views
    from pagas_cl.result import DepthResult
    from pagas_cl.runtime.device import Device
    from pagas_cl.scene.camera import Camera
    from pagas_cl.scene.check.cameras import check_cameras
    from pagas_cl.scene.depthmap import find_depth, load_depth, save_depth
    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.readers import read_scene
    from pagas_cl.scene.view import Scene, View

__all__ = [
    "Camera", "CameraRefinement", "Config", "DepthResult", "DepthScales", "Device", "DeviceError", "InputError",
    "KernelBuildError", "MissingExtraError", "PagasError", "Scene", "Surface", "View", "align_depth_scales",
    "check_cameras", "find_depth", "load_depth", "preset", "read_scene", "refine_cameras", "refine_depth",
    "refine_mesh", "refine_views", "save_depth", "tradeoff",
]

_HOME = {      # as the imports above
    "app.tradeoffs": ["tradeoff"], "config": ["Config"], "config.presets": ["preset"],
    "errors": ["DeviceError", "InputError", "KernelBuildError", "MissingExtraError", "PagasError"],
    "method.cameras.refine": ["CameraRefinement"], "method.view.one_view": ["refine_depth"],
    "method.surface.align_depth_scales": ["DepthScales", "align_depth_scales"],
    "refine": ["refine_cameras", "refine_mesh", "refine_views"], "result": ["DepthResult"],
    "runtime.device": ["Device"], "scene.camera": ["Camera"], "scene.check.cameras": ["check_cameras"],
    "scene.depthmap": ["find_depth", "load_depth", "save_depth"], "scene.mesh": ["Surface"],
    "scene.readers": ["read_scene"], "scene.view": ["Scene", "View"]}

if not TYPE_CHECKING:  # a checker would take any misspelt name for one that is loaded lazily

    def __getattr__(name):
        for module, names in _HOME.items():
            if name in names:
                value = getattr(import_module(f"pagas_cl.{module}"), name)
                globals()[name] = value
                return value
        raise AttributeError(f"module 'pagas_cl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
