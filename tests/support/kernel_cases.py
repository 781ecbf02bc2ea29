"""What the tests of the kernels share: a scene on a device, its gradient there and by the float64 twin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from support.random_scenes import exposed, gains, random_scene
from twins.level import loss_and_gradient, prepare
from twins.photo_loss import Photo
from twins.units import depth_threshold_of, median_depth

from pagas_cl.method.splat import exposure
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.level import Level, Phase
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.method.splat.step import loss_of
from pagas_cl.scene.view import View

SEES_LOSS = dict(solver__patience=5)          # the loss is summed only where the schedule follows it


def view_of(photo: Photo) -> View:
    """The 8-bit View that a twin's Photo came from."""
    return View(photo.camera, np.rint(photo.image * 255).astype(np.uint8), photo.mask, photo.camera.name)


@dataclass(frozen=True, eq=False)
class Scene:
    """A random scene in units of its median depth: initial depth and one after some steps, float32 (H, W)."""

    initial: np.ndarray
    moved: np.ndarray
    scene_scale: float
    target: Photo
    contexts: list[Photo]

    @classmethod
    def make(cls, seed: int, **settings) -> Scene:
        depth, target, contexts = random_scene(seed, **settings)
        scene_scale = median_depth(depth)
        initial = (depth / scene_scale).astype(np.float32)
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(depth.shape)
        return cls(initial, np.where(initial > 0, initial + noise, 0).astype(np.float32), scene_scale, target, contexts)

    def depth_threshold(self, config) -> float:
        return depth_threshold_of(self.initial.astype(np.float64), config.splatting.depth_slices)


def start_level(device, config, scene: Scene, specularity=None, raised=True) -> Level:
    """The level under the scene's initial depth; its buffer then holds the moved one. `raised`: as in late steps."""
    photos, views = PhotoStore(device), [view_of(p) for p in (scene.target, *scene.contexts)]
    given = LevelInput([v.camera for v in views], [photos.photo(v) for v in views], scene.scene_scale,
                       scene.depth_threshold(config),
                       1.0, len(scene.contexts), specularity=specularity)
    level = Level(device, config, given)
    cl.enqueue_copy(device.queue, level.buffers.depth, scene.initial)
    level.prepare()
    level.start()
    if raised:
        level.enter(Phase(config, raised=True))
    if config.loss.exposure:
        table = exposure.neutral(len(scene.contexts))
        table[1:] = gains(len(scene.contexts)).transpose(0, 2, 1)
        cl.enqueue_copy(device.queue, level.buffers.exposure, table)
    cl.enqueue_copy(device.queue, level.buffers.depth, scene.moved)
    return level


def device_gradient(device, config, scene: Scene) -> tuple[np.ndarray, float]:
    """N dL/dd of shape (H, W), not filtered, and L of the moved depth, on the device."""
    config = config.with_settings(solver__gradient_filter=0)
    level = start_level(device, config, scene)
    for launch in level.step_launches(0):
        launch.enqueue(device.queue)
    gradient = level.gradient()
    loss = loss_of(device, level.buffers)
    level.release()
    return gradient, loss


def twin_gradient(config, scene: Scene) -> tuple[np.ndarray, float]:
    """The same by the float64 twin."""
    contexts, initial = scene.contexts, scene.initial.astype(np.float64)
    if config.loss.exposure:
        contexts = exposed(contexts)
    state = prepare(initial, scene.target, contexts, config, scene.scene_scale, scene.depth_threshold(config))
    value, gradient = loss_and_gradient(scene.moved.astype(np.float64), scene.target, contexts, config, state)
    return gradient, value
