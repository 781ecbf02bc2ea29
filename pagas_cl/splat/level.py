"""One pyramid level: the steps of the flow, one after the other, for every context view (method sections 3 to 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.runtime.arena import Arena
from pagas_cl.runtime.program import Upload, run_once
from pagas_cl.runtime.transfer import download
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.rig import camera_table, footprint
from pagas_cl.splat import backward, composite, exposure, gradient_filter, loss, project, smooth, step
from pagas_cl.splat.options import defines, heaviest_pixel
from pagas_cl.splat.state import Size, allocate
from pagas_cl.splat.step_progress import StepProgress
from pagas_cl.splat.tile import choose_tiles


@dataclass(frozen=True)
class LevelInput:
    """What a level works on: the target first, then `contexts` context views, then views that only judge.

    Attributes
    ----------
    cameras : list of Camera
        At the level's size.
    photos : list of pyopencl.Buffer
        uchar4 per pixel, at the level's size.
    scene_scale : float
        Scene units per device unit.
    threshold : float
        Depth threshold, device units.
    viewing_distance : float
        Median distance of the cameras from the point they look at, device units.
    contexts : int
        Number of context views.
    host : tuple of ndarray of shape (H, W, 4), uint8
        Photos of all views but the target's, where the device holds one of them at a time: every photos[1:] is then
        the same buffer, which `fetch` fills.
    specularity : ndarray, optional
        Specularity measured on a grid over the target (Measurements.local_specularity).
    """

    cameras: list[Camera]
    photos: list[cl.Buffer]
    scene_scale: float
    threshold: float
    viewing_distance: float
    contexts: int
    host: tuple = ()
    specularity: np.ndarray | None = None

    def fetch(self, view: int) -> list:
        """What brings the photo of `view` to its buffer; nothing where it is there."""
        return [Upload(self.photos[view], self.host[view - 1])] if self.host and view else []

    @cached_property
    def sizes(self) -> list[Size]:
        return [Size(camera.width, camera.height) for camera in self.cameras]

    @cached_property
    def footprints(self) -> list[float]:
        """Of a pixel of each view (scene.rig.footprint), device units."""
        return [footprint(self.cameras[0], camera, self.scene_scale) for camera in self.cameras]


def threshold_in(given: LevelInput, config: Config, view: int) -> float:
    """delta of context view `view`, device units."""
    return max(given.threshold, config.splatting.depth_footprints * given.footprints[view])


class Level:
    """Buffers and bound launches of one level: `prepare`, `start`, then `run` refines arena["depth"] in place."""

    def __init__(self, device, config: Config, given: LevelInput):
        target, *contexts = given.sizes
        self.device, self.config, self.given = device, config, given
        self.defines = defines(config, device, heaviest_pixel(given.cameras[0]))
        self.target, self.contexts = target, contexts[:given.contexts]
        self.ssim_tile, self.loss_tile = choose_tiles(device, [size.grid for size in given.sizes])
        self.arena: Arena = allocate(device, config, target, contexts, given.contexts)
        cl.enqueue_copy(device.queue, self.arena["cameras"],
                        camera_table(given.cameras[0], given.cameras[1:], given.scene_scale))
        if config.loss.exposure:
            cl.enqueue_copy(device.queue, self.arena["exposure"], exposure.neutral(len(self.contexts)))

    def prepare(self, write):
        """Take units and unseen masks under the run's initial depth; `write(buffer)` enqueues its writing."""
        self._once(write, project.before_steps)

    def start(self, write):
        """The depth that the steps start from."""
        self._once(write, smooth.before_steps)
        self._bind_views()
        self.gradient_filter, self.ending = gradient_filter.launches(self), []
        self.smooth = smooth.launches(self, float(self.config.smoothness.weight))

    def _bind_views(self):
        self.view_launches = [self._view(v) for v in range(1, 1 + len(self.contexts))]
        # the target's own view has no gradient; it counts in the loss alone
        self.target_view = self._view(0) if self.config.loss.target_view and self.config.solver.patience else []

    def raise_smoothness(self):
        """From here on smoothness weighs what few context views and specularity call for."""
        run_once(self.device.queue, smooth.raising(self))
        for launch in self.smooth:
            launch.release()
        self.smooth = smooth.launches(self, self.config.smoothness.weight_with(len(self.contexts)))

    def _narrow(self):
        """Go on with the radius of the last steps: other programs, the same buffers."""
        self.config = self.config.with_settings(splatting__radius=self.config.splatting.final_radius,
                                                splatting__final_radius=0.0)
        self.defines = defines(self.config, self.device, heaviest_pixel(self.given.cameras[0]))
        for launches in (self.target_view, *self.view_launches):
            for launch in launches:
                launch.release()
        self._bind_views()

    def _once(self, write, launches):
        write(self.arena["depth"])
        run_once(self.device.queue, launches(self))

    def _view(self, view: int) -> list:
        """All launches of one context view, or of the target's own (0), in one step."""
        return [*self.given.fetch(view), *composite.launches(self, view), *loss.launches(self, view),
                *backward.launches(self, view)]

    def threshold(self, view: int) -> float:
        """Depth threshold in context view `view`: at least some of its footprints, or a slope would hide itself."""
        return threshold_in(self.given, self.config, view)

    @property
    def views_per_step(self) -> int:
        asked = self.config.solver.views_per_step
        return min(asked, len(self.contexts)) if asked else len(self.contexts)

    @property
    def views_in_loss(self) -> int:
        """Views that the loss is averaged over."""
        return self.views_per_step + (1 if self.config.loss.target_view else 0)

    def gradient_launches(self, number: int) -> list:
        """Launches that add N dL/dd of step `number` (from 0) to the gradient."""
        return self._photo_launches(number) + self.smooth

    def step_launches(self, number: int) -> list:
        """The same with the gradient of the photos filtered over neighbouring pixels, as a step wants it."""
        return self._photo_launches(number) + self.gradient_filter + self.smooth

    def _photo_launches(self, number: int) -> list:
        """Context views in turn."""
        k, n = self.views_per_step, len(self.view_launches)
        chosen = [self.view_launches[(number * k + j) % n] for j in range(k)]
        return [launch for view in (self.target_view, *chosen) for launch in view]

    def run(self, steps: int, progress=None) -> int:
        """At most `steps` steps; returns how many were enqueued. `progress(done, total)` is told of those that are
        done."""
        queue, solver, step_progress = self.device.queue, step.Solver(self), StepProgress(progress, steps)
        self.ending = solver.launches
        fitted = exposure.fitted_before(steps) if self.config.loss.exposure else ()
        for number in range(steps):
            if number in fitted:
                run_once(queue, exposure.launches(self))
            if number == self.config.solver.photos_first(steps):
                self.raise_smoothness()
            if self.config.splatting.final_radius and number == steps // 2:
                self._narrow()
            for launch in self.step_launches(number):
                launch.enqueue(queue)
            ended = solver.enqueue(number, steps)
            queue.flush()
            step_progress.enqueued(number + 1, ended)
            if solver.finished(number):
                steps = number + 1
                break
        step_progress.finish()
        return steps

    def read(self, name: str, shape, dtype=np.float32) -> np.ndarray:
        """Copy of the buffer `name` on the host."""
        return download(self.device, self.arena[name], shape, dtype)

    def release(self, keep=()):
        """Give everything back but the buffers named in `keep`."""
        for launches in (self.ending, self.target_view, self.gradient_filter, self.smooth, *self.view_launches):
            for launch in launches:
                launch.release()
        self.ending, self.target_view, self.gradient_filter, self.smooth, self.view_launches = [], [], [], [], []
        self.arena.release(keep)
