"""What is found of a view before its first step, in its turn or while the device is at the steps of the view before."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache

import numpy.typing as npt

from pagas_cl.config import Config
from pagas_cl.effects import Decision, relit_first
from pagas_cl.errors import DeviceMemoryError, InputError
from pagas_cl.measurements import Measurements, measure
from pagas_cl.resemblance import views_to_ask
from pagas_cl.runtime.device import Device
from pagas_cl.scene.choice import Partners
from pagas_cl.scene.inputs import checked_depth
from pagas_cl.scene.view import View
from pagas_cl.splat import NormalizedDepth, PhotoStore
from pagas_cl.splat.budget import fit_memory, plan_for


class BeforeSteps:
    """The depth of one of many views on the device (`on_device()`), which of its `partners` are `asked` and the
    `decision` on that, and what they show (`measured`), as far as it can be known.

    Parameters are those of one_view.refine_one. All of it is found on the queue beside the steps (Device.beside).
    """

    asked: Partners
    decision: Decision | None = None
    measured: Measurements | None = None
    on_device: Callable[[], NormalizedDepth]

    def __init__(self, views: Sequence[View] | Mapping[int, View], partners: Partners, depth: npt.ArrayLike,
                 config: Config, device: Device, photos: PhotoStore):
        self._views, self._partners, self._depth, self._config = views, partners, depth, config
        self._device, self._photos = device, photos
        self._parts = self._find()

    def _find(self) -> Iterator[None]:
        views, config, device, photos = self._views, self._config, self._device, self._photos
        target = views[self._partners.target]
        depth = checked_depth(self._depth, target)
        self.on_device = cache(lambda: NormalizedDepth(target, depth, device))
        fit_memory(lambda _: self.on_device(), target, (), config, device, photos)
        yield
        self.asked, self.decision = views_to_ask(views, self._partners, depth, config, device, photos, self.on_device)
        yield
        if config.effects.measured and not relit_first(config):
            contexts = [views[k] for k in self.asked.contexts]
            self.measured = fit_memory(
                lambda photos: measure(target, contexts, depth, config, device.beside, photos,
                                       normalized=self.on_device()), target, contexts, config, device, photos)

    def go_on(self) -> None:
        """Find another part, where the device has memory for it beside the view that it is at; whoever finishes is told
        of faults."""
        cameras = [self._views[k].camera for k in self._partners.all]
        if self._partners.contexts and self._device.memory.has_room(
                plan_for(cameras, len(cameras) - 1, self._config).nbytes):
            try:
                next(self._parts, None)
            except (InputError, DeviceMemoryError):
                self._parts = self._find()

    def finish(self) -> None:
        """Find what is left."""
        for _ in self._parts:
            pass
