"""The rounds of a refinement of cameras: frames, blocks, solution, motion; coarse to fine (method section 9)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pagas_cl.method.cameras.adjust import PRIOR, Block, Frame, MakeBlocks, Wanted
from pagas_cl.method.cameras.frames import Frames, through
from pagas_cl.method.cameras.motion import initial_rotations, moved, placed, register_to_mesh, rotated, twist_between
from pagas_cl.method.cameras.pairs import Pairs
from pagas_cl.method.cameras.solve import Term, Unknowns, assemble, pixel_scales, solve
from pagas_cl.progress import Progress, reported
from pagas_cl.runtime.memory import release
from pagas_cl.scene.camera import Camera

NEAR_ENOUGH, LOOSE, ANY = 0.01, 0.03, 0.5      # share of the depth by which views that see the same point may differ
STEP, FARTHEST_STEP = 1.0, 3.0       # most that a round moves: a depth, pixels of parallax; a camera, pixels
STILL = 0.01              # pixels of a size: a round that moves cameras by less is the last one there
INFLATION = 40.0          # residuals that say the same, within a window
LEAST_VARIANCE = 1e-6     # of a residual: photos of 8 bits leave more, what rounding alone leaves says nothing
STRANGE = 0.01            # by so much more than cameras and maps are off the scale of maps is taken to be their own
COMMON = 3.0              # maps may all be off alike by what one differs by within itself, over this
OFFSET = 9.0              # pixels; a photo offset by so many says as much of another as any other photo does
OFFSETS = ((0.0, 0.0), (OFFSET, 0.0), (-OFFSET, 0.0), (0.0, OFFSET), (0.0, -OFFSET))
DEPTH_STEPS = 3           # steps of the depths alone before pairs are judged


@dataclass(frozen=True)
class Stage:
    """One size: share of the finest one, most rounds, and whether depths are free."""

    share: float
    rounds: int
    free: bool = True


FINE = (Stage(0.5, 4), Stage(1.0, 10))
COARSE = (Stage(0.125, 8), Stage(0.25, 6), Stage(0.5, 6), Stage(1.0, 10))
MAPS = (Stage(0.0625, 8, False), Stage(0.125, 8, False), Stage(0.25, 6, False))


@dataclass
class State:
    """Where a refinement stands: `given` cameras hold the gauge, `cameras` are now; `lenses` as in Unknowns; `maps`
    (N, 2) scale and shift (units) of each depth map; `spread`: pixels that cameras are thought to be off by."""

    given: list[Camera]
    cameras: list[Camera]
    maps: np.ndarray
    spread: float
    lenses: tuple[int, ...] = ()
    lens_numbers: tuple[int, ...] = ()
    map_numbers: int = 0
    log: list[dict] = field(default_factory=list)

    def copy(self) -> "State":
        return replace(self, cameras=list(self.cameras), maps=self.maps.copy(), log=list(self.log))


def shifted(frame: Frame, x: float, y: float) -> Frame:
    return replace(frame, camera=replace(frame.camera, cx=frame.camera.cx + x, cy=frame.camera.cy + y))


class Rounds:
    """Runs stages over `pairs`. `typical`: depths of the views, units; `make_blocks` as in refine_cameras."""

    def __init__(self, frames: Frames, pairs: Pairs, typical: Sequence[float], progress: Progress,
                 make_blocks: MakeBlocks):
        self.frames, self.pairs, self.typical, self.progress = frames, pairs, typical, progress
        self.make_blocks = make_blocks
        self.adjuster = frames.adjuster
        self.scene_scale = self.adjuster.scene_scale

    def run(self, stages: Sequence[Stage], state: State) -> None:
        """All stages; `state` is changed. The surface stays as large as given: its scale goes into the cameras."""
        before: list[Frame] = []        # those of the stage, and with the depths that it started from
        initial: list[Frame] = []
        for stage in reported(self.progress, "refine the cameras", stages):
            now = self.frames.at(state.cameras, stage.share, state.maps)
            first = [self.adjuster.copied(frame) for frame in now]
            if before and stage.free:
                self.frames.carried(before, initial, now)
            release(*before, *initial)
            before, initial = now, first
            for _ in range(DEPTH_STEPS if stage.free and stage.share >= FINE[0].share else 0):
                self._blocks(now, NEAR_ENOUGH, sums=False)      # cameras are nearly right; else depths would hide it
            for _ in range(stage.rounds):
                before, step = self._round(before, state, stage)
                if step < STILL:
                    break
        if stages[-1].free and self.frames.moves:
            self._register_to_mesh(before, state)
        elif stages[-1].free:
            self._rescale(before, initial, state)
        release(*before, *initial)

    def _round(self, frames: list[Frame], state: State, stage: Stage) -> tuple[list[Frame], float]:
        tolerance = ANY if not stage.free else NEAR_ENOUGH if stage.share >= 0.5 else LOOSE
        terms = [Term(t, others, block) for (t, others), block in
                 zip(self._targets(), self._blocks(frames, tolerance, stage.free))]
        used = sum(float(term.block.used.sum()) for term in terms)
        squares = sum(float(term.block.squares.sum()) for term in terms)
        if not used:
            return frames, 0.0
        share = frames[0].camera.width / state.cameras[0].width
        unknowns = self._unknowns(frames, state, stage)
        system, right = assemble(terms, [frame.camera for frame in frames], self.scene_scale, unknowns)
        there = self._moved(state, unknowns, share)
        variance = INFLATION * max(squares / used, LEAST_VARIANCE)
        y, spread = solve(system, right, there, variance, max(state.spread * share, 1e-3))
        state.spread = spread / share
        steps = y - there
        poses = steps[:6 * len(frames)].reshape(-1, 6)
        largest = float(np.sqrt((poses**2).mean(axis=1)).max())
        steps *= min(1.0, FARTHEST_STEP / max(largest, 1e-9))
        state.log.append({"share": share, "residual": squares / used, "spread": state.spread, "step": largest / share})
        self._apply(frames, state, unknowns, steps / unknowns.scales, share)
        return through(frames, state.cameras), largest

    def _targets(self) -> list[tuple[int, tuple[int, ...]]]:
        """Places of views that have context views, and those of these."""
        return [(target, others) for target, others in enumerate(self.pairs.used) if others]

    def _blocks(self, frames: Sequence[Frame], tolerance: float, free: bool = True, sums: bool = True) -> list[Block]:
        wanted = []
        for target, others in self._targets():
            slope = self._slope(frames, target, others)
            wanted.append(Wanted(target, others, PRIOR * slope**2 if free else np.inf, tolerance,
                                 STEP / slope if free else 0.0, sums))
        return self.make_blocks(self.adjuster, frames, wanted)

    def _slope(self, frames: Sequence[Frame], target: int, others: Sequence[int]) -> float:
        """Pixels of parallax a unit of depth, at a depth of 1: root mean square over the context views."""
        squares = []
        for k in others:
            camera = frames[k].camera
            away = np.linalg.norm(camera.center - frames[target].camera.center) / self.scene_scale
            squares.append(camera.fx * camera.fy * away**2)
        return max(float(np.sqrt(np.mean(squares))), 1e-6)

    def _unknowns(self, frames: Sequence[Frame], state: State, stage: Stage) -> Unknowns:
        cameras = [frame.camera for frame in frames]
        lenses = max(state.lenses, default=-1) + 1
        radius = 0.3 * np.hypot(cameras[0].width, cameras[0].height)
        depth = 0 if stage.free else state.map_numbers
        shift = [self._slope(frames, t, others) if others else 1.0 for t, others in enumerate(self.pairs.used)]
        maps = np.array([[s * z, s] for s, z in zip(shift, self.typical)])[:, :depth]
        lens_scales = np.tile([radius, 1.0, 1.0], lenses)
        scales = np.concatenate([pixel_scales(cameras, self.typical), lens_scales, maps.ravel()])
        return Unknowns(len(cameras), scales, state.lenses, state.lens_numbers, depth)

    def _moved(self, state: State, unknowns: Unknowns, share: float) -> np.ndarray:
        """How far all unknowns are from where they were given, pixels of a size of that share."""
        there = np.zeros(len(unknowns.scales))
        for k, (given, now) in enumerate(zip(state.given, state.cameras)):
            there[unknowns.pose(k)] = twist_between(given, now, self.scene_scale)
            if unknowns.lenses:
                lens = [np.log(now.fx / given.fx), share * (now.cx - given.cx), share * (now.cy - given.cy)]
                there[unknowns.lens(k)] = np.array(lens)[list(unknowns.lens_numbers)]
            if unknowns.depth:
                there[unknowns.map(k)] = [np.log(state.maps[k, 0]), state.maps[k, 1]][:unknowns.depth]
        return there * unknowns.scales

    def _apply(self, frames: Sequence[Frame], state: State, unknowns: Unknowns, steps: np.ndarray,
               share: float) -> None:
        for k, camera in enumerate(state.cameras):
            camera = moved(camera, steps[unknowns.pose(k)], self.scene_scale)
            if unknowns.lenses:
                lens = np.zeros(3)
                lens[list(unknowns.lens_numbers)] = steps[unknowns.lens(k)]
                camera = replace(camera, fx=camera.fx * np.exp(lens[0]), fy=camera.fy * np.exp(lens[0]),
                                 cx=camera.cx + lens[1] / share, cy=camera.cy + lens[2] / share)
            state.cameras[k] = camera
            if unknowns.depth:
                step = steps[unknowns.map(k)]
                scale = np.exp(step[0])
                shift = step[1] if unknowns.depth == 2 else 0.0
                state.maps[k] = state.maps[k] * scale + [0.0, shift]
                self.adjuster.rescale(frames[k], scale, shift)

    def _register_to_mesh(self, frames: Sequence[Frame], state: State) -> None:
        """Let the surface that photos see lie where the mesh does."""
        own = [frames[target] for target, _ in self._targets()]
        cameras = [frame.camera for frame in own]
        depths = [self.adjuster.read(frame, frame.depth) * self.scene_scale for frame in own]
        spread = state.spread * frames[0].camera.width / state.cameras[0].width
        state.cameras = list(map(register_to_mesh(cameras, depths, self.frames.depths(cameras), spread), state.cameras))

    def _rescale(self, frames: Sequence[Frame], initial: Sequence[Frame], state: State) -> None:
        """Let the surface be as large as it was given, as far as it shows that better than the cameras, which are off
        by `spread`; depth maps by their change on the whole, all alike perhaps by a third of what one differs within
        itself. A scale that is not the cameras' is put into `state.maps` instead."""
        ratios, within, sizes = [], [], []
        for frame, before in zip(frames, initial):
            now, then = self.adjuster.read(frame, frame.depth), self.adjuster.read(frame, before.depth)
            valid = (now > 0) & (then > 0)
            if valid.any():
                ratio = np.log(then[valid].astype(np.float64) / now[valid])
                ratios.append(float(np.median(ratio)))
                within.append(float(np.median(abs(ratio - ratios[-1]))))
                sizes.append(int(valid.sum()))
        if not ratios:
            return
        wanted = float(np.average(ratios, weights=sizes))
        by_surface = float(np.var(ratios)) / len(ratios) + (float(np.median(within)) / COMMON) ** 2 + 1e-12
        centers, first = (np.array([camera.center for camera in those]) for those in (state.cameras, state.given))
        middle = centers.mean(axis=0)
        around, size = centers - middle, max(float(((centers - middle) ** 2).sum()), 1e-300)
        own = float(np.log(max(((first - first.mean(axis=0)) * around).sum() / size, 0.5)))     # that of those given
        focal = float(np.mean([camera.fx for camera in state.cameras]))
        error = state.spread * float(np.median(self.typical)) * self.scene_scale / focal      # of a centre's coordinate
        by_cameras = error**2 / size
        if (wanted - own) ** 2 > by_surface + 9 * by_cameras + STRANGE**2:
            state.maps *= np.exp(own - wanted)       # the maps have a scale of their own, not that of the cameras
            wanted = own
        scale = float(np.exp((wanted * by_cameras + own * by_surface) / (by_cameras + by_surface)))
        state.cameras = [placed(camera, camera.world_to_camera[:3, :3], middle + scale * offset)
                         for camera, offset in zip(state.cameras, around)]
        state.log.append({"scale": scale, "surface": wanted, "given": own})

    def judged(self, cameras: Sequence[Camera], maps: np.ndarray, pairs: Sequence[tuple[int, int]],
               share: float) -> np.ndarray:
        """Mean robust cost of `pairs`, both ways, pixels seen, and the mean cost with one photo offset (pairs, 3);
        NaN where nothing is seen; at a share of the finest size. The depths first follow the pairs that are used."""
        frames = self.frames.at(cameras, share, maps)
        for _ in range(DEPTH_STEPS):
            self._blocks(frames, NEAR_ENOUGH, sums=False)
        out = []
        for pair in pairs:
            rows = sum(self.adjuster.costs(frames[one], [shifted(frames[two], *offset) for offset in OFFSETS], LOOSE)
                       for one, two in (pair, pair[::-1]))
            cost, seen = rows[0]
            offset_cost, offset_seen = rows[1:].sum(axis=0)
            out.append((cost / seen if seen else np.nan, seen, offset_cost / offset_seen if offset_seen else np.nan))
        release(*frames)
        return np.array(out).reshape(-1, 3)

    def rotated(self, state: State, share: float) -> tuple[list[Camera], float]:
        """The cameras after initial_rotations, and by how many pixels (of full size) whole photos are offset."""
        frames = self.frames.at(state.cameras, share, state.maps)
        normals = [self.adjuster.read(frame, frame.normal) for frame in frames]
        depths = [self.adjuster.read(frame, frame.depth) * self.scene_scale for frame in frames]
        release(*frames)
        pairs = sorted({(min(one, k), max(one, k)) for one, others in enumerate(self.pairs.used) for k in others})
        rotations, offset = initial_rotations([frame.camera for frame in frames], normals, depths, pairs)
        return ([rotated(camera, rotation) for camera, rotation in zip(state.cameras, rotations)],
                offset * state.cameras[0].width / frames[0].camera.width)

    def agreement(self, state: State, share: float) -> np.ndarray:
        """Of each view: the median over its pairs of the mean robust cost, as they are; NaN without any. (N,)"""
        frames = self.frames.at(state.cameras, share, state.maps)
        pair_costs: list[list[float]] = [[] for _ in frames]
        for target, others in self._targets():
            for other, (cost, seen) in zip(others, self.adjuster.costs(frames[target], [frames[k] for k in others],
                                                                       4 * LOOSE)):
                if seen:
                    pair_costs[target].append(cost / seen)
                    pair_costs[other].append(cost / seen)
        release(*frames)
        return np.array([np.median(costs) if costs else np.nan for costs in pair_costs])
