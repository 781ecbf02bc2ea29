"""Context choice: which other views constrain a target, and which only judge, from what its depth says both see.

No photo and no sparse point is needed. Up to 2000 of the target's depths are carried to the candidates; what counts is
the share that lands in front and inside, is not hidden behind that view's own initial depth, and is seen at an angle
useful for depth. With many cameras the candidates are first cut by simple geometry.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pagas_cl.config import Context
from pagas_cl.config.stages import MOST_CONTEXTS
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.inputs import check_maps
from pagas_cl.scene.sampling import SAMPLES, DepthSample, sample_depth, sample_pixels

MOST_HELD_OUT = 3       # most views that only judge
SPARE_ONE = 6           # with so many usable views, one is spared for that even where all could be used
_SAMPLED = 64           # with more views than this, planning looks at samples of their depth maps
_MANY = 64              # with more cameras than this the candidates are cut first
_HIDDEN = 1.02          # a point this much deeper than the other view's own surface is hidden there
_RISE, _FALL = 8.0, 25.0  # degrees: the angle score is 1 between them and falls towards the limits of the setting


@dataclass(frozen=True)
class ContextChoice:
    """Context views of a target, most useful first, as `indices` into the list of cameras.

    `overlaps`: share of the target's valid depths that the view sees at an angle within the settings' limits; `angles`:
    median between the rays of target and view, degrees; `reason`: empty, or why there are fewer views than wanted.
    """

    indices: tuple[int, ...]
    overlaps: tuple[float, ...]
    angles: tuple[float, ...]
    reason: str = ""


class ContextChooser:
    """Chooses for one target after another; what all targets share is worked out once.

    `depths` are the cameras' initial ones, (H, W) in scene units. A target needs one; another view without one is taken
    to hide nothing, and so are all where they do not `hide`. `samples` of its depths are looked at.
    """

    def __init__(self, cameras: Sequence[Camera], depths: Sequence[np.ndarray | DepthSample | None],
                 settings: Context = Context(), samples: int = SAMPLES, hide: bool = True):
        check_maps(cameras, depths)
        self.cameras, self.depths, self.settings = list(cameras), list(depths), settings
        self._samples = samples if len(cameras) <= 1000 else min(samples, SAMPLES // 4)
        if cameras:
            self._centers = np.array([c.center - cameras[0].center for c in cameras])
            self._rotations = np.array([c.world_to_camera[:3, :3] for c in cameras])
            self._focal, self._middle, self._size = np.moveaxis(
                np.array([((c.fx, c.fy), (c.cx, c.cy), (c.width, c.height)) for c in cameras], np.float64), 1, 0)
            farthest, widths, cells = zip(*(_farthest(depth if hide else None) for depth in depths))
            self._farthest, self._rows = farthest, np.array([widths, cells])

    def choose(self, target: int) -> ContextChoice:
        points, z = self._points(target)
        if len(z) == 0:
            return ContextChoice((), (), (), "its initial depth has no valid pixel (finite and above 0)")
        candidates = self._candidates(target, points)
        u, v, depth, angle, inside = self._project(target, candidates, points)
        seen = inside & ~self._hidden(candidates, u, v, depth, inside)
        useful = seen & (angle >= self.settings.min_angle) & (angle <= self.settings.max_angle)
        overlap = useful.mean(axis=1)
        # a view whose pixels are coarser on the surface than the target's shows less
        coarser = depth / self._focal[candidates].mean(axis=1)[:, None] / (z / self._focal[target].mean())
        score = useful * _angle_score(angle, self.settings) / np.maximum(coarser, 1)
        usable = (overlap >= self.settings.min_overlap) & (overlap > 0)
        order = _greedy(score, np.flatnonzero(usable), self.settings.number)
        wanted = min(self.settings.number, len(self.cameras) - 1)
        reason = "" if len(order) == wanted > 0 else self._reason(len(order), inside, seen, useful, angle)
        return ContextChoice(tuple(int(candidates[k]) for k in order), tuple(float(overlap[k]) for k in order),
                             tuple(float(np.median(angle[k][useful[k]])) for k in order), reason)

    def all(self) -> list[ContextChoice]:
        return [self.choose(target) for target in range(len(self.cameras))]

    def _points(self, target: int) -> tuple[np.ndarray, np.ndarray]:
        """Sampled surface points of the target, (N, 3) relative to the first camera's centre, and their depth (N,)."""
        camera, depth = self.cameras[target], self.depths[target]
        if depth is None:
            return np.zeros((0, 3)), np.zeros(0)
        if isinstance(depth, DepthSample):
            keep = slice(None, None, max(1, -(-len(depth.rows) // self._samples)))
            rows, columns, z = depth.rows[keep], depth.columns[keep], depth.depth[keep]
        else:
            rows, columns = sample_pixels(depth, self._samples)
            z = depth[rows, columns]
        z = z.astype(np.float64)
        return (camera.rays_at(rows, columns) * z[:, None]) @ self._rotations[target] + self._centers[target], z

    def _candidates(self, target: int, points: np.ndarray) -> np.ndarray:
        """Other cameras worth a close look, in their order; all of them while they are few."""
        if len(self.cameras) <= _MANY:
            return np.delete(np.arange(len(self.cameras)), target)
        keep = max(3 * self.settings.number, 32)
        middle = np.median(points, axis=0)  # all cameras, one point: distance, angle, side
        away = middle - self._centers
        distance = np.maximum(np.sqrt(np.einsum("ni,ni->n", away, away)), 1e-300)
        extent = np.percentile(np.linalg.norm(points - middle, axis=1), 90) / distance[target]
        angle = np.degrees(np.arccos(np.clip(away @ away[target] / (distance * distance[target]), -1, 1)))
        coarser = distance / self._focal[:, 0] / (distance[target] / self._focal[target, 0])
        ahead = np.einsum("ni,ni->n", away, self._rotations[:, 2]) > -extent * distance[target]
        near = ahead & (angle <= self.settings.max_angle + np.degrees(np.arctan(extent))) & (coarser < 8)
        near[target] = False
        found = np.flatnonzero(near)
        if len(found) > 16 * keep:
            rough = (1 + _angle_score(angle[found], self.settings)) / np.maximum(coarser[found], 1)
            found = np.sort(found[np.argsort(-rough, kind="stable")[:16 * keep]])
        few = points[::max(1, len(points) // 24)]  # the rest, a few points
        *_, angle, inside = self._project(target, found, few)
        score = (inside * _angle_score(angle, self.settings)).sum(axis=1)
        best = np.argsort(-score, kind="stable")[:keep]
        return np.sort(found[best])

    def _project(self, target: int, which: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Points in cameras `which`: pixels u, v, depth, degrees to the target's rays, are they seen: each (M, N)."""
        points = np.ascontiguousarray(points.T)         # by coordinate: four times as fast
        away = points - self._centers[which][..., None]
        x, y, depth = np.moveaxis(self._rotations[which] @ away, 1, 0)
        (fx, fy), (cx, cy) = (each[which].T[..., None] for each in (self._focal, self._middle))
        ahead = np.where(depth > 0, depth, 1)
        own = points - self._centers[target][:, None]
        length = np.sqrt(np.einsum("min,min->mn", away, away) * np.einsum("in,in->n", own, own))
        cosine = np.einsum("min,in->mn", away, own) / np.maximum(length, 1e-300)
        u, v = x / ahead * fx + cx, y / ahead * fy + cy
        width, height = self._size[which].T[..., None]
        inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        return u, v, depth, np.degrees(np.arccos(np.clip(cosine, -1, 1))), inside

    def _hidden(self, which: np.ndarray, u: np.ndarray, v: np.ndarray, depth: np.ndarray,
                inside: np.ndarray) -> np.ndarray:
        """Points that lie behind the other view's own surface."""
        across, down = (np.where(inside, at, 0).astype(np.intp) for at in (u, v))
        widths, cells = self._rows[:, which, None]
        if (cells > 1).any():
            across, down = across // cells, down // cells
        found = [self._farthest[j].take(places) for j, places in zip(which, down * widths + across)]
        behind = _HIDDEN * np.reshape(found, inside.shape)
        return np.asarray(inside & (behind > 0) & (depth > behind))

    def _reason(self, found: int, inside: np.ndarray, seen: np.ndarray, useful: np.ndarray, angle: np.ndarray) -> str:
        """Why so few of the candidates are usable: each counted under the first that fails."""
        settings, others = self.settings, len(self.cameras) - 1
        if others == 0:
            return "there is no other view"
        blind, blocked, odd = (part.mean(axis=1) < max(settings.min_overlap, 1e-12) for part in (inside, seen, useful))
        blocked, odd = blocked & ~blind, odd & ~blocked & ~blind
        with np.errstate(invalid="ignore"):
            middle = np.nanmedian(np.where(seen[odd], angle[odd], np.nan), axis=1) if odd.any() else np.zeros(0)
        near, far = middle < settings.min_angle, middle >= settings.min_angle
        causes = {f"see less than {settings.min_overlap:.0%} of what it sees": blind.sum() + others - len(inside),
                  "are blocked by nearer surfaces": blocked.sum(),
                  f"are too close to its place (rays below {settings.min_angle:g} degrees)": near.sum(),
                  f"look from too far to the side (rays above {settings.max_angle:g} degrees)": far.sum()}
        reasons = "; ".join(f"{count} {what}" for what, count in causes.items() if count)
        return f"{found} of {others} other views are usable" + (f": {reasons}" if reasons else "")


def _farthest(depth: np.ndarray | DepthSample | None) -> tuple[np.ndarray, int, int]:
    """The depth behind which a view sees nothing, by rows; how long these are, and pixels along a side of each."""
    if depth is None:
        return np.zeros(1, np.float32), 0, 1 << 30
    farthest, cell = (depth.farthest, depth.cell) if isinstance(depth, DepthSample) else (depth, 1)
    return farthest.ravel(), farthest.shape[1], cell


def _angle_score(angle: np.ndarray, settings: Context) -> np.ndarray:
    """0 to 1: how much an angle in degrees shows of depth while the two photos still look alike."""
    rise, fall = max(_RISE, settings.min_angle), min(max(_FALL, settings.min_angle), settings.max_angle)
    up = angle / rise
    down = 1 - 0.9 * (angle - fall) / max(settings.max_angle - fall, 1e-9)
    within = (angle >= settings.min_angle) & (angle <= settings.max_angle)
    return np.where(within, np.clip(np.minimum(up, down), 0.01, 1), 0)


def _greedy(score: np.ndarray, usable: np.ndarray, number: int) -> list[int]:
    """Up to `number` of `usable`, each the one that adds most to the sum over samples of sqrt(score so far)."""
    # the root makes a region's second view worth less than its first: every part of the target is to be seen
    score, total, order = score[usable], np.zeros(score.shape[1]), list[int]()
    for _ in range(min(number, len(score))):
        gain = np.sqrt(total + score).sum(axis=1)
        gain[order] = -1
        order.append(int(np.argmax(gain)))      # the first of equals
        total += score[order[-1]]
    return [int(usable[k]) for k in order]


@dataclass(frozen=True)
class Partners:
    """Places in the list of views: contexts, most useful first, and usable views that are held out.

    `reason`: why there are fewer context views than wanted.
    """

    target: int
    contexts: tuple[int, ...]
    held_out: tuple[int, ...] = ()
    reason: str = ""

    @property
    def all(self) -> tuple[int, ...]:
        return (self.target, *self.contexts, *self.held_out)

    def refined(self, views: Collection[int]) -> list[int]:
        """The view itself, then its context views, as far as they are among the refined `views`."""
        return [self.target, *(k for k in self.contexts if k in views)]


def for_planning(depth: np.ndarray | DepthSample | None, views: int) -> np.ndarray | DepthSample | None:
    """What is needed of a depth map (or None) to choose partners among so many views: all of it, or a sample."""
    return depth if depth is None or views <= _SAMPLED or isinstance(depth, DepthSample) else sample_depth(depth)


def shared_out(usable: tuple[int, ...], number: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Of usable views, most useful first: the context views, at most `number`, and the held-out views."""
    used = min(number, len(usable) - 1 if len(usable) >= SPARE_ONE else len(usable))
    return usable[:used], usable[used:number + MOST_HELD_OUT]


class PartnerChooser:
    """Chooses for one target after another; parameters as in ContextChooser."""

    def __init__(self, cameras: Sequence[Camera], depths: Sequence[np.ndarray | DepthSample | None], settings: Context):
        self._number = settings.number
        depths = [for_planning(depth, len(cameras)) for depth in depths]
        more = min(settings.number + MOST_HELD_OUT, MOST_CONTEXTS)
        self._chooser = ContextChooser(cameras, depths, replace(settings, number=more))

    def choose(self, target: int) -> Partners:
        choice = self._chooser.choose(target)
        contexts, held_out = shared_out(choice.indices, self._number)
        return Partners(target, contexts, held_out, choice.reason)
