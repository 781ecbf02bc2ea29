"""One pyramid level: the steps of the flow, one after the other, for every context view (method sections 3 to 6)."""

from dataclasses import dataclass, replace
from itertools import chain
from math import inf

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat import composite, exposure, gradient_filter, loss, project, smooth, step
from pagas_cl.method.splat.buffers import EvidenceBuffers, LevelBuffers
from pagas_cl.method.splat.constants import MOST_MOVED
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.options import Programs
from pagas_cl.runtime.memory import constant, download, release
from pagas_cl.runtime.program import run_once


@dataclass(frozen=True)
class Phase:
    """Steps of a level from one on: the `config` of the views' programs, and whether smoothness is `raised`."""

    config: Config
    raised: bool


@dataclass(frozen=True)
class Schedule:
    """What changes between the steps of a level: `phases` and fits of exposure, by the step from 0; fits come first."""

    phases: dict[int, Phase]
    fits: frozenset[int] = frozenset()

    @classmethod
    def of(cls, config: Config, steps: int, again: bool = False) -> "Schedule":
        """For so many steps; `again`: from a refined depth, so that one fit of exposure will do."""
        raised_from = config.solver.raised_from(steps)
        final = config.splatting.final_radius
        late = config.with_settings(splatting__radius=final, splatting__final_radius=0.0) if final else config
        phases = {start: Phase(late if start >= steps // 2 else config, raised=start >= raised_from)
                  for start in sorted({0, raised_from, steps // 2})}
        fits = exposure.fitted_before(1 if again else steps) if config.loss.exposure else ()
        return cls(phases, frozenset(fits))

    @property
    def last_phase_only(self) -> "Schedule":
        """The last phase for all steps, without fits."""
        return Schedule({0: self.phases[max(self.phases)]})


class Level:
    """Buffers and bound launches of one level: `prepare`, `start`, then `run` refines buffers.depth in place."""

    def __init__(self, device, config: Config, given: LevelInput):
        self.device, self.config, self.given = device, config, given
        self.programs = self._first = Programs(device, config, given.cameras)
        self.target, *views = given.views(config)
        self.views, self.judges = views[:given.contexts], views[given.contexts:]
        self.buffers = LevelBuffers.allocated(device, given.dimensions(config))
        cl.enqueue_copy(device.queue, self.buffers.cameras, given.camera_table)
        if config.loss.exposure:
            cl.enqueue_copy(device.queue, self.buffers.exposure, constant(device, exposure.neutral(len(self.views))))
        self.phase: Phase | None = None
        self.target_view, self.smooth, self.ending = [], [], []
        self._view_launches: dict[int, list] = {}
        self._moved = [inf] * len(self.views)      # pixels of parallax at most, since each view's z-buffer was made

    def prepare(self):
        """Take units and unseen masks under the run's initial depth, which buffers.depth holds."""
        run_once(self.device.queue, project.before_steps(self.programs, self.buffers, self.target, len(self.views)))

    def start(self):
        """Get ready for the steps, which start from what buffers.depth holds."""
        run_once(self.device.queue, smooth.before_steps(self.programs, self.buffers, self.target))
        self.enter(Phase(self.config, raised=False))

    def enter(self, phase: Phase):
        """Go on as `phase` says: other programs of the views, other weights, the same buffers."""
        before = self.phase
        self.phase = phase
        if before is None or phase.raised != before.raised:
            self._weigh_smoothness(phase.raised)
        if before is None or phase.config != before.config:
            self._change_programs(phase.config)

    def _weigh_smoothness(self, raised: bool):
        weight = self.config.smoothness.early * self.config.smoothness.weight
        if raised:
            run_once(self.device.queue,
                     smooth.raising(self._first, self.buffers, self.target, self.given.specularity))
            weight = self.config.smoothness.weight_with(len(self.views))
        release(*self.smooth)
        self.smooth = [*gradient_filter.launches(self._first, self.buffers, self.target, weight),
                       *smooth.launches(self._first, self.buffers, self.target, weight)]

    def _change_programs(self, config: Config):
        before = self.programs.config.splatting.radius
        self.programs = self._first if config == self.config else Programs(self.device, config, self.given.cameras)
        release(*self.target_view, *chain(*self._view_launches.values()))
        self._view_launches = {}
        if config.splatting.radius != before:
            self._moved = [inf] * len(self.views)
        # the target's own view has no gradient; it counts in the loss alone
        self.target_view = self._view(self.target) if config.loss.target_view and config.solver.patience else []

    def launches_of(self, number: int) -> list:
        """All launches of context view `number` in one step, bound when first needed, while the device is at work."""
        if number not in self._view_launches:
            surface = self.buffers.surfaces[number] if self.buffers.surfaces else None
            self._view_launches[number] = self._view(replace(self.views[number], z_first=surface))
        return self._view_launches[number]

    def _view(self, view) -> list:
        """All launches of one context view, or of the target's own, in one step."""
        given = self.programs, self.buffers, view
        views_in_loss = self.views_per_step + (1 if self.config.loss.target_view else 0)
        return [*view.fetch(), *composite.launches(*given), *loss.launches(*given, views_in_loss),
                *composite.backward(*given)]

    @property
    def views_per_step(self) -> int:
        wanted = self.config.solver.views_per_step or len(self.views)
        return min(wanted, len(self.views))

    def step_launches(self, number: int) -> list:
        """Launches that make the gradient of step `number` (from 0), context views in turn."""
        found = list(self.target_view)
        for place in range(number * self.views_per_step, (number + 1) * self.views_per_step):
            found += self._turn(place % len(self.views))
        return found + self.smooth

    def _turn(self, view: int) -> list:
        """The launches of context view `view`, with its z-buffer made anew only where depths have moved."""
        if self.buffers.surfaces and self._moved[view] <= MOST_MOVED:
            return [launch for launch in self.launches_of(view) if launch.stage != "nearest"]
        self._moved[view] = 0.0
        return self.launches_of(view)

    def solver(self) -> step.Solver:
        return step.Solver(self._first, self.buffers, self.target.size, self.given.viewing_distance)

    def run(self, steps: int, on_step=None, schedule: Schedule | None = None) -> int:
        """At most `steps` steps; how many were enqueued. `on_step(done, total)` follows each (`report_rest`)."""
        schedule = schedule or Schedule.of(self.config, steps)
        queue, solver = self.device.queue, self.solver()
        self._reported = step.StepProgress(on_step, steps)
        self.ending = solver.launches
        for number in range(steps):
            if number in schedule.fits:
                run_once(queue, exposure.launches(self.programs, self.buffers, self.views))
            if number in schedule.phases:
                self.enter(schedule.phases[number])
            for launch in self.step_launches(number):
                launch.enqueue(queue)
            ended = solver.enqueue(number, steps)
            farthest = solver.rate(number, steps)
            self._moved = [moved + farthest for moved in self._moved]
            queue.flush()
            self._reported.enqueued(number + 1, ended)
            if solver.finished(number):
                steps = number + 1
                break
        return steps

    def report_rest(self):
        """Wait for the last steps of `run`: when what comes after them is enqueued."""
        self._reported.finish()

    def read(self, name: str, shape, dtype=np.float32) -> np.ndarray:
        return download(self.device, getattr(self.buffers, name), shape, dtype)

    def gradient(self) -> np.ndarray:
        """N dL/dd of shape (H, W), of the step whose launches were enqueued last, on the host."""
        return self.read("followed" if self.buffers.followed else "gradient", self.target.size.shape)

    def release(self):
        self._release_launches()
        self.buffers.release()

    def hand_over(self) -> EvidenceBuffers:
        """What the evidence needs, the caller's from now on; everything else is given back."""
        self._release_launches()
        return self.buffers.hand_over(EvidenceBuffers)

    def _release_launches(self):
        release(*self.ending, *self.target_view, *self.smooth, *chain(*self._view_launches.values()))
        self.ending, self.target_view, self.smooth, self._view_launches = [], [], [], {}
