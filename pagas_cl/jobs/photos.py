"""Decoded photos that a worker keeps while there is room, so that each is read once, and before it is needed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Lock

import numpy as np

from pagas_cl.scene.view import View

LIMIT_BYTES = 1 << 30


class PhotoMemory:
    """The photos and masks used last, up to `limit` bytes. Any thread may ask."""

    def __init__(self, limit: int = LIMIT_BYTES):
        self.limit, self._held, self._bytes, self._lock = limit, OrderedDict(), 0, Lock()

    def remembered(self, view: View, digest: str) -> View:
        """The same view, whose photo and mask come from here."""
        mask = None if view.mask is None else Remembered(self, (digest, "mask"), view.load_mask)
        return View(view.camera, Remembered(self, (digest, "image"), view.load_image), mask, view.name)

    def get(self, key, load) -> np.ndarray:
        """The array `key`, by `load()` where it is not held; who comes while it is loaded waits for it."""
        with self._lock:
            promise = self._held.pop(key, None)
            first = promise is None
            self._held[key] = promise = Future() if first else promise  # last in the order of use
        if first:
            self._load(key, load, promise)
        return promise.result()

    def _load(self, key, load, promise: Future) -> None:
        try:
            pixels = load()
        except BaseException as error:
            with self._lock:
                self._held.pop(key, None)
            promise.set_exception(error)
            return
        with self._lock:
            promise.set_result(pixels)
            self._bytes += pixels.nbytes
            for old in [k for k, held in self._held.items() if held.done() and k != key]:
                if self._bytes <= self.limit:
                    break
                self._bytes -= self._held.pop(old).result().nbytes


@dataclass(frozen=True, eq=False)
class Remembered:
    """Stands for a view's photo or mask."""

    memory: PhotoMemory
    key: tuple
    read: Callable[[], np.ndarray]

    def load(self) -> np.ndarray:
        return self.memory.get(self.key, self.read)
