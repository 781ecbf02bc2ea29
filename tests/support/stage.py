"""A stage of a step by itself: programs, buffers and a view, and no level around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pytest
from support.kernel_cases import Scene, view_of
from twins.level import LevelState, prepare

from pagas_cl.config.presets import BALANCED, PAPER
from pagas_cl.method.splat.buffers import LevelBuffers
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.options import Programs
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.runtime.memory import download
from pagas_cl.runtime.program import run_once

ORDER_FREE = BALANCED.with_settings(splatting__low_pass=0.0, solver__patience=0)
ALPHA = PAPER.with_settings(solver__patience=0)
BLENDS = pytest.mark.parametrize("config", [ORDER_FREE, ALPHA], ids=["order-free", "alpha"])


@dataclass
class Stage:
    """What a stage is launched with, all buffers at their start but the depth, and the twin's state."""

    device: object
    programs: Programs
    buffers: LevelBuffers
    views: list
    twin: LevelState

    @classmethod
    def make(cls, device, config, scene: Scene) -> Stage:
        photos, views = PhotoStore(device), [view_of(p) for p in (scene.target, *scene.contexts)]
        given = LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene.scene_scale,
                           scene.depth_threshold(config), 1.0, len(scene.contexts))
        buffers = LevelBuffers.allocated(device, given.dimensions(config))
        made = cls(device, Programs(device, config, given.cameras), buffers, given.views(config),
                   prepare(scene.initial.astype(np.float64), scene.target, scene.contexts, config, scene.scene_scale,
                           scene.depth_threshold(config)))
        made.put(depth=scene.moved, cameras=given.camera_table)
        return made

    def put(self, **arrays):
        """Into the buffers of these names."""
        for name, array in arrays.items():
            cl.enqueue_copy(self.device.queue, getattr(self.buffers, name), np.ascontiguousarray(array, np.float32))

    def run(self, launches, name: str, shape, dtype=np.float32) -> np.ndarray:
        """What the buffer `name` holds after the launches."""
        run_once(self.device.queue, launches)
        return download(self.device, getattr(self.buffers, name), shape, dtype).astype(np.float64)
