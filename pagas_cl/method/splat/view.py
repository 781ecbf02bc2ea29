"""Refine the depth map of one view: a pure function of target, contexts, depth and settings (method section 7)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.errors import log
from pagas_cl.method.splat.budget import plan_for
from pagas_cl.method.splat.buffers import Size, level_size
from pagas_cl.method.splat.evidence import Evidence, EvidencePrior
from pagas_cl.method.splat.hypotheses import Hypotheses
from pagas_cl.method.splat.inputs import LevelInput
from pagas_cl.method.splat.level import Level, Schedule
from pagas_cl.method.splat.measure import Probe, ProbeResult
from pagas_cl.method.splat.photos import PhotoStore, StreamedPhotos
from pagas_cl.method.splat.resample import Resampler
from pagas_cl.method.splat.shading import relit
from pagas_cl.method.splat.units import NormalizedDepth, Start, room_for
from pagas_cl.scene.camera import viewing_distance
from pagas_cl.scene.depthmap import REFINED


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the levels leave: arrays of the target's full size (H, W), lengths in scene units."""

    depth: np.ndarray           # refined, float32; 0 = no surface
    status: np.ndarray          # uint8, as in scene/depthmap.py
    deviation: np.ndarray       # of the depth, standard, float32; infinite where nothing is known, 0 without a surface
    parallax: np.ndarray        # depth change that moves a pixel by one in the context views, float32; 0: none sees it
    cost: tuple[float, float]   # mean 1 - correlation of patches with the context photos, before and after
    held_out: tuple[tuple[float, float], ...]
    """Median 1 - correlation with each photo that took no part, before and after, over the pixels that it sees; NaN
    where there are none."""
    uninformative: int          # depths that only smoothness moved, far from any that photos confirm: kept
    steps: tuple[int, ...]      # those done at each level
    mismatch: float             # both as EvidenceDecision has them
    resolved: float
    losses: list[float]         # of each step, where the schedule follows it
    device_bytes: int           # most that this process held on the device meanwhile, photos of other views included
    planned_bytes: int          # planned before it began, without those

    def updated(self, later: "Refinement") -> "Refinement":
        """This one, and what a `later` one, which began with its depth or another, has refined: in that one's arrays,
        since new ones take longer than what is written into them."""
        left = later.status != REFINED
        for name in ("depth", "status", "deviation", "parallax"):
            np.copyto(getattr(later, name), getattr(self, name), where=left)
        held_out = tuple((before, after) for (before, _), (_, after) in zip(self.held_out, later.held_out))
        return replace(later, cost=(self.cost[0], later.cost[1]), held_out=held_out,
                       steps=self.steps + later.steps, losses=self.losses + later.losses)


def refine_levels(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore | None = None, *,
                  on_step=None, held_out=(), measured=None, normalized: NormalizedDepth | None = None,
                  start: Start | None = None) -> Refinement:
    """Run the pyramid on one view with at least one context view; `depth` (H, W), z in scene units, 0 = no surface.

    `photos` are a PhotoStore (a new one by default) or StreamedPhotos; `on_step(done, total)` is called when the
    device has done a step, of those of all levels; `held_out` views take no part and judge the result; evidence and
    deviations depend on `measured` (Measurements); `normalized` is the depth where it is on the device already, and is
    used up. `start`: where the steps of a full-size level alone start from, in place of `depth`, which the evidence
    compares with; what photos say of the whole (cost, held_out) is not known then. DeviceMemoryError comes before the
    first step, where the device may not hold what is planned.
    """
    photos = photos or PhotoStore(device)
    cameras = [view.camera for view in (target, *contexts, *held_out)]
    planned = plan_for(cameras, len(contexts), config, isinstance(photos, StreamedPhotos))
    if start is not None:
        planned = replace(planned, other=planned.other + start.depth.size + start.nbytes)
    planned.check(target.name, device)
    log.debug("view %s: %s MB of device memory are planned, %s MB of it photos", target.name,
              f"{planned.nbytes / 1e6:,.1f}", f"{planned.photos / 1e6:,.1f}")
    photos.trim(planned.other)
    device.memory.begin(planned.nbytes + photos.bytes_of_others((target, *contexts, *held_out)))
    run = _Run(target, contexts, depth, config, device, photos, held_out=held_out, normalized=normalized,
               specularity=measured.local_specularity if measured else None)
    into = start.into if start else room_for(depth.shape).result
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
            before = level.buffers.take("depth"), level.target.size
            level.release()
            del level            # its photos too, before those of the next one
    found = run.finish(level, EvidencePrior.of(measured), tuple(done), losses, planned.nbytes, start, into)
    level.report_rest()
    if on_step and done[-1] < steps:                # the schedule has ended it
        on_step(total, total)
    return found


def full_level(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore | None = None) -> Level:
    """The full-size level, ready for its first step from the initial depth."""
    return _Run(target, contexts, depth, config, device, photos or PhotoStore(device)).level(1.0)


def probe_view(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore | None = None, *,
               normalized: NormalizedDepth | None = None, scale: float = 1.0) -> ProbeResult:
    """What the context views show under the initial depth, at `scale` of the photos' size."""
    with _probe(target, contexts, depth, config, device, photos or PhotoStore(device), normalized, scale) as probe:
        return probe.read()


def explained_by(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore, *, scale: float,
                 normalized: NormalizedDepth | None = None) -> tuple[np.ndarray, np.ndarray]:
    """What Probe.read_explained finds at `scale` of the photos' size."""
    with _probe(target, contexts, depth, config, device, photos, normalized, scale) as probe:
        return probe.read_explained()


@contextmanager
def hypotheses_for(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore,
                   normalized: NormalizedDepth) -> Iterator[Hypotheses]:
    """Context of a search for depths where photos match badly under the initial one; parameters are those of
    refine_levels, whose `normalized` depth is not used up."""
    run = _Run(target, contexts, depth, config, device, photos, normalized=normalized)
    given = run.at(1.0)
    found = Hypotheses(device, given, given.views(config), normalized.buffer)
    try:
        yield found
    finally:
        found.release()


def relit_views(target, contexts, depth, config: Config, device, photos, *,
                normalized: NormalizedDepth | None = None) -> list:
    """`contexts` with photos lit as the target's is, as far as the depth shows it (method section 5.3); parameters are
    those of probe_view. Let go of them with photos.forget."""
    with _probe(target, contexts, depth, config, device, photos, normalized) as probe:
        return relit(probe, contexts, photos)


@contextmanager
def _probe(target, contexts, depth, config, device, photos, normalized, scale: float = 1.0) -> Iterator[Probe]:
    run = _Run(target, contexts, depth, config, device, photos, normalized=normalized)
    given = run.at(scale)
    probe = Probe(device, config, given, lambda out: run.write_initial(out, given.sizes[0]))
    yield probe
    probe.release()


class _Run:
    """One view's inputs at any level, and its way back to scene units."""

    def __init__(self, target, contexts, depth, config, device, photos, *, held_out=(),
                 normalized: NormalizedDepth | None = None, specularity=None):
        self.views = [target, *contexts]
        self.held_out = list(held_out)
        self.config, self.device, self.photos = config, device, photos
        self.specularity = specularity
        self.resampler = Resampler(device, config)
        self.full = Size(target.camera.width, target.camera.height)
        self.normalized = normalized or NormalizedDepth(target, depth, device)
        self.scene_scale = self.normalized.scene_scale
        self.depth_threshold = self.normalized.depth_range / config.splatting.depth_slices
        self.distance = 1.0
        if config.solver.rate_unit == "distance":
            distance = viewing_distance([view.camera for view in self.views]) / self.scene_scale
            self.distance = distance if np.isfinite(distance) else 1.0

    def at(self, scale: float) -> LevelInput:
        views = self.views + (self.held_out if scale == 1 else [])
        sizes = [level_size(view.camera, scale) for view in views]
        cameras = [view.camera.resized(*size.grid) for view, size in zip(views, sizes)]
        photos, host = self.photos.level(views, sizes, self.resampler)
        return LevelInput(cameras, photos, self.scene_scale, self.depth_threshold, self.distance, len(self.views) - 1,
                          host, self.specularity)

    def write_initial(self, out: cl.Buffer, size: Size):
        self.resampler.shrink_depth(self.normalized.buffer, self.full, out, size)

    def level(self, scale: float, before: tuple[cl.Buffer, Size] | None = None,
              start: Start | None = None) -> Level:
        """The level at `scale`, ready for its first step from the initial depth, or from that of the level `before`, of
        its size."""
        level = Level(self.device, self.config, self.at(scale))
        out, size = level.buffers.depth, level.target.size
        self.write_initial(out, size)
        level.prepare()
        if before is not None:
            at_size = self.device.memory.buffer(self.device.context, 4 * size.pixels)
            self.write_initial(at_size, size)
            self.resampler.enlarge_depth(*before, at_size, out, size)
        if start is not None:
            self.normalized.start_from(start.depth, out, size.pixels)
        level.start()
        return level

    def finish(self, level: Level, prior: EvidencePrior, steps, losses, planned: int,
               start: Start | None, into: Callable[[], Sequence[np.ndarray]]) -> Refinement:
        programs, buffers, initial = level.programs, level.hand_over(), self.normalized.buffer
        contexts = Evidence(programs, buffers, level.views, initial, prior)
        held_out = [Evidence(programs, buffers, [view], initial, prior) for view in level.judges]
        decision = contexts.decide(held_out, start is None)
        depth, parallax, deviation, status = self.normalized.denormalize(
            buffers.depth, buffers.depth_per_parallax, decision.status, decision.deviation, into(), start)
        for held in (buffers, contexts, decision, self.normalized):
            held.release()
        return Refinement(depth, status, deviation, parallax, decision.cost, decision.held_out,
                          decision.uninformative, steps, decision.mismatch, decision.resolved, losses,
                          self.device.memory.peak, planned)
