"""How much device memory the refinement of a view will take, known before; and the same in what the device has."""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from pagas_cl.config import Config
from pagas_cl.errors import DeviceMemoryError, log
from pagas_cl.method.splat import carry_over, hypotheses, mismatch
from pagas_cl.method.splat.buffers import EvidenceBuffers, LevelBuffers, dimensions
from pagas_cl.method.splat.evidence import sums_bytes
from pagas_cl.method.splat.inputs import ViewInput
from pagas_cl.method.splat.measure import probe_bytes
from pagas_cl.method.splat.photos import StreamedPhotos, photo_bytes
from pagas_cl.runtime.arena import total_bytes
from pagas_cl.runtime.device import translate_cl_errors
from pagas_cl.scene.camera import Camera, Size

# Settings that need less memory, tried in this order where a view does not fit; all of them change the result.
LEANER = ({"loss__grey": True}, {"splatting__blend": "order_free"},
          {"splatting__blend": "order_free", "loss__grey": True})


@dataclass(frozen=True)
class Plan:
    """Bytes at the peak: `photos` that the view needs, and `other` for all else."""

    photos: int
    other: int

    @property
    def nbytes(self) -> int:
        return self.photos + self.other

    def check(self, name: str, device) -> None:
        limit = device.memory.limit
        if self.nbytes > limit:
            raise DeviceMemoryError(f"view {name!r} needs {self.nbytes / 1e6:,.0f} MB, {device.info.title} may hold "
                                    f"{limit / 1e6:,.0f} MB")


def plan_for(cameras: list[Camera], contexts: int, config: Config, streamed: bool = False) -> Plan:
    """The plan of a refinement for the cameras of the target, of `contexts` context views, and of the held-out views;
    `streamed`: photos wait on the host (StreamedPhotos)."""
    return _plan_of(tuple(camera.size for camera in cameras), contexts, config, streamed)


@lru_cache(16)
def _plan_of(sizes: tuple[Size, ...], contexts: int, config: Config, streamed: bool) -> Plan:
    """The same for photos of these sizes, which views of a scene have alike."""
    plans = [_at(scale, sizes, contexts, config, streamed) for scale in config.pyramid.scales]
    if config.effects.measured:         # beforehand, with the initial depth there
        sizes = sizes[:1 + contexts]
        plans.append(Plan(_photos(sizes, sizes, streamed), probe_bytes(config, sizes, contexts) + 8 * sizes[0].pixels))
    if hypotheses.is_enabled(config, contexts):
        searched = hypotheses.Hypotheses.nbytes(sizes[0], contexts) + 8 * sizes[0].pixels
        plans.append(Plan(_photos(sizes[:1 + contexts], sizes[:1 + contexts], streamed), searched))
    return max(plans, key=lambda plan: plan.nbytes)


def _at(scale: float, full: tuple[Size, ...], contexts: int, config: Config, streamed: bool) -> Plan:
    full = full if scale == 1 else full[:1 + contexts]
    sizes = tuple(size.scaled(scale) for size in full)
    lengths = dimensions(config, sizes[0], sizes[1:], contexts)
    scales, carries = config.pyramid.scales, config.pyramid.carry_over
    depths = 8 * full[0].pixels          # the initial one, as given and in units
    if scale > scales[0]:       # what the level before has left
        before = full[0].scaled(scales[scales.index(scale) - 1]).pixels
        depths += carry_over.LEFT_BYTES * before if carries else 4 * (sizes[0].pixels + before)
    if scale < 1 and carries:   # what this one leaves, while that is found
        depths += carry_over.NBYTES * sizes[0].pixels
    during = after = total_bytes(LevelBuffers.plan(lengths)) + depths
    if scale == 1:           # evidence before and after: of the context views, and of one held-out view at a time
        judges = 2 if len(full) > 1 + contexts else 1
        after = total_bytes(EvidenceBuffers.plan(lengths)) + depths
        smoothing = mismatch.nbytes(full[0].pixels, lengths["samples"]) if mismatch.is_enabled(config) else 0
        after += 29 * full[0].pixels + max(smoothing, 24 * (judges - 1) * full[0].pixels)
        after += sums_bytes(len(full) - 1 - contexts)
    return Plan(_photos(full, sizes, streamed), max(during, after))


def _photos(full: Sequence[Size], sizes: Sequence[Size], streamed: bool) -> int:
    """Bytes of photos at the level's size, and of those of full size where that is another."""
    if streamed:
        place = max((photo_bytes(size.pixels) for size in sizes[1:]), default=0)
        shrunk = max(photo_bytes(size.pixels) for size in full) if sizes != full else 0
        return photo_bytes(sizes[0].pixels) + place + 2 * shrunk
    return sum(photo_bytes(size.pixels) for size in full) + sum(
        photo_bytes(small.pixels) for small, size in zip(sizes, full) if small != size)


def fit_memory(attempt: Callable[[ViewInput], Any], given: ViewInput, config: Config) -> Any:
    """`attempt(given)`, or, where the device cannot hold that, the same with photos that wait on the host, of the same
    bytes. DeviceMemoryError, with a setting or a size that fits, where it still cannot; DeviceLostError."""
    device, doing = given.device, f"the refinement of view {given.target.name!r}"
    plan = [view.camera for view in given.views], len(given.contexts), config
    try:
        plan_for(*plan).check(given.target.name, device)
        with translate_cl_errors(device, doing):
            return attempt(given)
    except DeviceMemoryError as error:
        log.warning("%s: its photos wait on the host and go to the device one at a time, which takes longer and gives "
                    "the same", str(error))      # text: the error itself would hold its frames and their buffers
    given.photos.clear()
    gc.collect()             # what the attempt held goes before the next one begins
    try:
        with translate_cl_errors(device, doing):
            return attempt(replace(given, photos=StreamedPhotos(device)))
    except DeviceMemoryError as error:
        raise DeviceMemoryError(f"{error}, even with one photo at a time; {what_fits(*plan, device)}") from error


def check_device_memory(cameras: Sequence[Camera], config: Config, device) -> None:
    """Before any work: DeviceMemoryError where `device` holds not even the smallest of these views, at its leanest."""
    smallest = sorted(cameras, key=lambda camera: camera.size.pixels)[:2]
    leanest = [config.with_settings(**change) for change in ({}, *LEANER)]
    needed = min(plan_for(smallest, len(smallest) - 1, lean, streamed=True).nbytes for lean in leanest)
    if needed > device.memory.limit:
        raise DeviceMemoryError(f"a view of {smallest[0].width} x {smallest[0].height} needs {needed / 1e6:,.1f} MB at "
                                f"least, {device.info.title} may hold {device.memory.limit / 1e6:,.1f} MB; "
                                f"{what_fits(smallest, len(smallest) - 1, config, device)}")


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
