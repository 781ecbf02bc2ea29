"""A view's refinement in the memory that the device has: with all photos there, or with one at a time."""

import gc
import logging

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError
from pagas_cl.runtime.faults import translate_cl_errors
from pagas_cl.scene.camera import Camera
from pagas_cl.splat.budget import plan_for
from pagas_cl.splat.photos import PhotoStore, StreamedPhotos

log = logging.getLogger("pagas_cl")

# Settings that need less memory, tried in this order where a view does not fit; all of them change the result.
LEANER = ({"loss__grey": True}, {"splatting__blend": "order_free"},
          {"splatting__blend": "order_free", "loss__grey": True})


def fit_memory(attempt, target, contexts, config: Config, device, photos: PhotoStore, *, held_out=()):
    """`attempt(photos)` with a PhotoStore, or, where the device cannot hold that, with photos that wait on the host:
    the kernels read the same bytes and give the same. DeviceMemoryError where it does not fit even so; the message
    names a setting, or a size of photos, that does. DeviceLostError where the device failed meanwhile."""
    cameras = [view.camera for view in (target, *contexts, *held_out)]
    doing, given = f"the refinement of view {target.name!r}", (cameras, len(contexts), config)
    try:
        plan_for(*given).check(target.name, device)
        with translate_cl_errors(device, doing):
            return attempt(photos)
    except DeviceMemoryError as error:
        log.warning("%s: its photos wait on the host and go to the device one at a time, which takes longer and gives "
                    "the same", str(error))      # text: the error itself would hold its frames and their buffers
    photos.clear()
    gc.collect()             # what the attempt held goes before the next one begins
    try:
        with translate_cl_errors(device, doing):
            return attempt(StreamedPhotos(device))
    except DeviceMemoryError as error:
        raise DeviceMemoryError(f"{error}, even with one photo at a time; {what_fits(*given, device)}") from error


def what_fits(cameras: list[Camera], contexts: int, config: Config, device) -> str:
    """What to change so that the view fits: a setting, or the size of the photos."""
    def fits(changed: Config, share: float = 1.0) -> bool:
        return plan_for([_shrunk(camera, share) for camera in cameras], contexts, changed,
                        streamed=True).nbytes <= device.memory.limit

    if fits(config):
        return "close other programs that use the device"
    for change in LEANER:
        if fits(config.with_settings(**change)):
            options = " ".join(f"--set {name.replace('__', '.')}={str(value).lower()}" for name,
                               value in change.items())
            return f"it fits with {options}"
    share = 0.95
    while share > 1e-4 and not fits(config, share):
        share *= 0.95
    size = _shrunk(cameras[0], share)
    return f"it fits with photos of {size.width} x {size.height} (Camera.resized), or choose another device"


def _shrunk(camera: Camera, share: float) -> Camera:
    return camera.resized(max(1, int(camera.width * share)), max(1, int(camera.height * share)))
