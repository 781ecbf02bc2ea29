"""Decoded photos that a worker keeps while there is room, so that each is read once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pagas_cl.scene.view import View

LIMIT_BYTES = 1 << 30


class PhotoMemory:
    """The photos and masks used last, up to `limit` bytes."""

    def __init__(self, limit: int = LIMIT_BYTES):
        self.limit, self._held, self._bytes = limit, OrderedDict(), 0

    def remembered(self, view: View, digest: str) -> View:
        """The same view, whose photo and mask come from here."""
        mask = None if view.mask is None else Remembered(self, (digest, "mask"), view.load_mask)
        return View(view.camera, Remembered(self, (digest, "image"), view.load_image), mask, view.name)

    def get(self, key, load) -> np.ndarray:
        """The array `key`, by `load()` where it is not held."""
        pixels = self._held.pop(key, None)
        if pixels is None:
            pixels = load()
            self._bytes += pixels.nbytes
        self._held[key] = pixels  # last in the order of use
        while self._bytes > self.limit and len(self._held) > 1:
            self._bytes -= self._held.popitem(last=False)[1].nbytes
        return pixels


@dataclass(frozen=True, eq=False)
class Remembered:
    """Stands for a view's photo or mask."""

    memory: PhotoMemory
    key: tuple
    read: Callable[[], np.ndarray]

    def load(self) -> np.ndarray:
        return self.memory.get(self.key, self.read)
