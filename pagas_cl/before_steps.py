"""What is found of a view before its first step, in its turn or while the device is at the steps of the view before."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy.typing as npt

from pagas_cl.config import Config
from pagas_cl.effects import Decision, relit_first
from pagas_cl.errors import DeviceLostError
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
        self._left = [BeforeSteps._ask, BeforeSteps._measure]
        self._fails = not partners.contexts

    def go_on(self) -> None:
        """Find another part, where the device has memory for a view beside the one that it is at. Nothing more where
        that fails: it is tried again, and told, by whoever finishes; but DeviceLostError, since that view is lost."""
        cameras = [self._views[k].camera for k in self._partners.all]
        if not self._left or self._fails or not self._device.memory.has_room(
                plan_for(cameras, len(cameras) - 1, self._config).nbytes):
            return
        try:
            self._next()
        except DeviceLostError:
            raise
        except Exception:  # whatever it is, the view that the device is at must not suffer
            self._fails = True

    def finish(self) -> None:
        """Find what is left."""
        while self._left:
            self._next()

    def _next(self) -> None:
        self._left[0](self)
        del self._left[0]

    def _ask(self) -> None:
        device, target = self._device, self._views[self._partners.target]
        self._depth = depth = checked_depth(self._depth, target)
        self.on_device = cache(lambda: NormalizedDepth(target, depth, device))
        self.asked, self.decision = views_to_ask(self._views, self._partners, depth, self._config, device, self._photos,
                                                 self.on_device)

    def _measure(self) -> None:
        config, device, on_device = self._config, self._device, self.on_device
        if config.effects.measured and not relit_first(config):
            target, contexts = self._views[self.asked.target], [self._views[k] for k in self.asked.contexts]
            self.measured = fit_memory(
                lambda photos: measure(target, contexts, self._depth, config, device.beside, photos,
                                       normalized=on_device()), target, contexts, config, device, self._photos)
