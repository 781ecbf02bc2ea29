"""Refine the depth map of one view: a pure function of target, contexts, depth and settings (method section 7)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.errors import log
from pagas_cl.method.splat.budget import plan_for
from pagas_cl.method.splat.carry_over import follow
from pagas_cl.method.splat.edges import choose_surfaces
from pagas_cl.method.splat.evidence import Evidence, EvidencePrior
from pagas_cl.method.splat.hypotheses import Hypotheses
from pagas_cl.method.splat.inputs import LevelInput, ViewInput
from pagas_cl.method.splat.level import Level, Schedule
from pagas_cl.method.splat.measure import Probe, ProbeResult
from pagas_cl.method.splat.photos import StreamedPhotos
from pagas_cl.method.splat.resample import Resampler
from pagas_cl.method.splat.shading import relit
from pagas_cl.method.splat.starts import better_of, places
from pagas_cl.method.splat.units import NormalizedDepth, Start, WhenNeeded, room_for
from pagas_cl.runtime.host import side_by_side
from pagas_cl.runtime.memory import download, release
from pagas_cl.scene.camera import Size, viewing_distance
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.view import View


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the levels leave: arrays of the target's full size (H, W), lengths in scene units."""

    depth: np.ndarray           # refined, float32; 0 = no surface
    status: np.ndarray          # uint8, as in scene/depthmap.py
    deviation: np.ndarray       # of the depth, standard, float32; infinite where nothing is known, 0 without a surface
    parallax: np.ndarray        # depth change that moves a pixel by one in the context views, float32; 0: none sees it
    cost: tuple[float, float]   # mean 1 - correlation of patches with the context photos, before and after
    held_out: tuple[tuple[float, float], ...]
    """Median 1 - correlation with each photo that took no part, before and after; NaN: it sees nothing."""
    uninformative: int          # depths that only smoothness moved, far from any that photos confirm: kept
    steps: tuple[int, ...]      # those done at each level
    mismatch: float             # both as EvidenceDecision has them
    resolved: float
    losses: list[float]         # of each step, where the schedule follows it
    device_bytes: int           # most that this process held on the device meanwhile, photos of other views included
    planned_bytes: int          # planned before it began, without those

    def updated(self, later: "Refinement") -> "Refinement":
        """This one, and what a `later` one has refined, in that one's arrays: new ones would take longer."""
        left = later.status != REFINED
        side_by_side(lambda name: np.copyto(getattr(later, name), getattr(self, name), where=left),
                     ("depth", "status", "deviation", "parallax"))
        held_out = tuple((before, after) for (before, _), (_, after) in zip(self.held_out, later.held_out))
        return replace(later, cost=(self.cost[0], later.cost[1]), held_out=held_out,
                       steps=self.steps + later.steps, losses=self.losses + later.losses)


def refine_levels(given: ViewInput, config: Config, *, on_step=None, measured=None,
                  start: Start | None = None) -> Refinement:
    """Run the pyramid on one view with at least one context view, whose normalized depth is used up.

    `on_step(done, total)` is called when the device has done a step, of those of all levels; evidence and deviations
    depend on `measured` (Measurements). `start`: where the steps of a full-size level alone start from, in place of the
    given depth, which the evidence compares with; what photos say of the whole (cost, held_out) is not known then.
    DeviceMemoryError comes before the first step, where the device may not hold what is planned."""
    photos, device = given.photos, given.device
    cameras = [view.camera for view in given.views]
    planned = plan_for(cameras, len(given.contexts), config, isinstance(photos, StreamedPhotos))
    if start is not None:
        planned = replace(planned, other=planned.other + start.depth.size + start.nbytes)
    planned.check(given.target.name, device)
    log.debug("view %s: %s MB of device memory are planned, %s MB of it photos", given.target.name,
              f"{planned.nbytes / 1e6:,.1f}", f"{planned.photos / 1e6:,.1f}")
    photos.trim(planned.other)
    device.memory.begin(planned.nbytes + photos.bytes_of_others(given.views))
    run = _Run(given, config, given.held_out, measured.local_specularity if measured else None)
    into = start.into if start else room_for(given.depth.shape).result
    before, done, losses = None, [], []
    total = sum(config.pyramid.steps)
    for number, (scale, steps) in enumerate(zip(config.pyramid.scales, config.pyramid.steps)):
        level = run.level(scale, before, start)
        earlier = sum(config.pyramid.steps[:number])
        done.append(level.run(steps, on_step and (lambda done, _, earlier=earlier: on_step(earlier + done, total)),
                              Schedule.of(config, steps, start is not None)))
        if level.buffers.history is not None:
            losses += level.read("history", max(config.pyramid.steps))[:done[-1]].tolist()
        if scale < 1:
            level.report_rest()
            before = run.leave(level)
            level.release()
            del level            # its photos too, before those of the next one
    found = run.finish(level, EvidencePrior.of(measured), tuple(done), losses, planned.nbytes, start, into)
    level.report_rest()
    if on_step and done[-1] < steps:                # the schedule has ended it
        on_step(total, total)
    return found


def full_level(given: ViewInput, config: Config) -> Level:
    """The full-size level, ready for its first step from the initial depth."""
    return _Run(given, config).level(1.0)


def probe_view(given: ViewInput, config: Config, scale: float = 1.0) -> ProbeResult:
    """What the context views show under the initial depth, at `scale` of the photos' size."""
    with _probe(given, config, scale) as probe:
        return probe.read()


def explained_by(given: ViewInput, config: Config, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """What Probe.read_explained finds at `scale` of the photos' size."""
    with _probe(given, config, scale) as probe:
        return probe.read_explained()


@contextmanager
def hypotheses_for(given: ViewInput, config: Config) -> Iterator[Hypotheses]:
    """Context of a search for depths where photos match badly under the initial one."""
    at_full_size = _Run(given, config).at(1.0)
    found = Hypotheses(given.device, at_full_size, at_full_size.views(config), given.normalized())
    try:
        yield found
    finally:
        found.release()


def better_start(given: ViewInput, move: Callable[[cl.Buffer], None], config: Config) -> np.ndarray:
    """The depth to start from, float32 (H, W): the `given` one where photos match better near it than near what `move`
    makes of it, on the device, for most of what is around, else that."""
    given = given.with_depth(given.depth.astype(np.float32, copy=False))
    device, size, start = given.device, given.target.camera.size, given.normalized()
    moved = device.buffer(4 * size.pixels)
    cl.enqueue_copy(device.queue, moved, start.given)
    move(moved)
    depth = download(device, moved, size.shape)
    there = WhenNeeded(partial(NormalizedDepth, given.target, depth, device, moved))
    other = replace(given, depth=depth, normalized=there)
    costs = []
    for view in (given, other):
        with hypotheses_for(view, config) as found:
            costs.append(found.costs_nearby(*places(device, size)))
    better = better_of(device, size, (start.given, moved), costs)
    release(*costs, start, there(), moved)
    return better


def resolve_edges(given: ViewInput, config: Config, known: Mapping[str, cl.Buffer],
                 count_support: Callable[[cl.Buffer, int, cl.Buffer], None]) -> None:
    """As choose_surfaces, of a view whose depth on the device is `known["depth"]`."""
    run = _Run(given, config)
    choose_surfaces(given.device, run.at(1.0), config, run.normalized, known, count_support)
    run.normalized.release()


def relit_views(given: ViewInput, config: Config) -> list[View]:
    """The context views with photos lit as the target's is (method section 5.3). Let go of them with photos.forget."""
    with _probe(given, config) as probe:
        return relit(probe, given.contexts, given.photos)


@contextmanager
def _probe(given: ViewInput, config: Config, scale: float = 1.0) -> Iterator[Probe]:
    run = _Run(given, config)
    at_size = run.at(scale)
    probe = Probe(given.device, config, at_size, lambda out: run.write_initial(out, at_size.sizes[0]))
    yield probe
    probe.release()


class _Run:
    """One view's inputs at any level, and its way back to scene units; at full size with photos of `judges`, too."""

    def __init__(self, given: ViewInput, config: Config, judges: Sequence[View] = (), specularity=None):
        self.views, self.judges = [given.target, *given.contexts], list(judges)
        self.config, self.device, self.photos = config, given.device, given.photos
        self.specularity = specularity
        self.resampler = Resampler(given.device, config)
        self.full = given.target.camera.size
        self.normalized = given.normalized()
        self.scene_scale = self.normalized.scene_scale
        self.depth_threshold = self.normalized.depth_range / config.splatting.depth_slices
        self.distance = 1.0
        if config.solver.rate_unit == "distance":
            distance = viewing_distance([view.camera for view in self.views]) / self.scene_scale
            self.distance = distance if np.isfinite(distance) else 1.0

    def at(self, scale: float) -> LevelInput:
        views = self.views + (self.judges if scale == 1 else [])
        cameras = [view.camera.scaled(scale) for view in views]
        photos, host = self.photos.level(views, [camera.size for camera in cameras], self.resampler)
        return LevelInput(cameras, photos, self.scene_scale, self.depth_threshold, self.distance, len(self.views) - 1,
                          host, self.specularity)

    def write_initial(self, out: cl.Buffer, size: Size):
        self.resampler.shrink_depth(self.normalized.buffer, self.full, out, size)

    def level(self, scale: float, before: Callable[[cl.Buffer, Size], None] | None = None,
              start: Start | None = None) -> Level:
        """The level at `scale`, ready for its first step from the initial depth, or what level `before` has left."""
        level = Level(self.device, self.config, self.at(scale))
        out, size = level.buffers.depth, level.target.size
        self.write_initial(out, size)
        level.prepare()
        if before is not None:
            before(out, size)
        if start is not None:
            self.normalized.start_from(start.depth, out, size.pixels)
        level.start()
        return level

    def leave(self, level: Level) -> Callable[[cl.Buffer, Size], None]:
        """What makes of the initial depth of the next level, of its size, that which it starts from."""
        depth, small = level.buffers.take("depth"), level.target.size
        if self.config.pyramid.carry_over:
            initial = self.device.buffer(4 * small.pixels)
            self.write_initial(initial, small)
            followed = follow(self.device, small, 0.0, initial, depth, level.buffers.depth_per_parallax)
            release(initial, depth)
            return partial(followed.carry_over, self.device)

        def enlarge(out: cl.Buffer, size: Size) -> None:
            initial = self.device.buffer(4 * size.pixels)
            self.write_initial(initial, size)
            self.resampler.enlarge_depth(depth, small, initial, out, size)
            release(initial, depth)

        return enlarge

    def finish(self, level: Level, prior: EvidencePrior, steps, losses, planned: int,
               start: Start | None, into: Callable[[], Sequence[np.ndarray]]) -> Refinement:
        programs, buffers, initial = level.programs, level.hand_over(), self.normalized.buffer
        contexts = Evidence(programs, buffers, level.views, initial, prior)
        held_out = [Evidence(programs, buffers, [view], initial, prior) for view in level.judges]
        decision = contexts.decide(held_out, start is None)
        depth, parallax, deviation, status = self.normalized.denormalize(
            buffers.depth, buffers.depth_per_parallax, decision.status, decision.deviation, into(), start)
        release(buffers, contexts, decision, self.normalized)
        return Refinement(depth, status, deviation, parallax, decision.cost, decision.held_out,
                          decision.uninformative, steps, decision.mismatch, decision.resolved, losses,
                          self.device.memory.peak, planned)
