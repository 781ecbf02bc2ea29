"""A case (one view to measure settings on, with its context views, photos kept out of it, the truth if known), how good
a depth map of it is, the settings that `pagas-cl tradeoff` measures, and one of them run on a case."""

import hashlib
import json
import time
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pagas_cl.app.evaluate.depth import compare_depth, depth_per_parallax
from pagas_cl.app.tradeoffs.costs import Cost, probe, view_steps, views_of_step
from pagas_cl.config import Config, Context, Effects
from pagas_cl.config.presets import preset
from pagas_cl.errors import InputError, log
from pagas_cl.jobs.task import results_version
from pagas_cl.method.cameras.judge import fitted_poses
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.method.view.prediction import compare_predictions, sized
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import central_normals, surface_depth
from pagas_cl.scene.inputs import depth_maps
from pagas_cl.scene.names import file_stems, place_of
from pagas_cl.scene.view import View, checked_views
from pagas_cl.system.files import digest_array, digest_of

_HELD_OUT_PLACES = (1, 4)  # of the choice of contexts: well-placed photos, but not the best one


@dataclass(frozen=True, eq=False)
class BenchmarkCase:
    """One view to measure on. Depth maps are (H, W) float32 z-depth, 0 = no surface."""

    name: str
    target: View
    contexts: list[View] = field(repr=False)            # most useful first; a setting with n of them takes the first n
    held_out: list[View] = field(repr=False)            # photos that no setting sees
    initial: np.ndarray = field(repr=False)
    truth: np.ndarray | None = field(default=None, repr=False)

    @property
    def pixels(self) -> int:
        return self.target.camera.size.pixels

    @cached_property
    def digest(self) -> str:
        """By which views of the same name differ: what is measured on, what it is compared with, and what judges."""
        views = self.target, *self.contexts, *self.held_out
        arrays = [array for view in views for array in (view.camera.world_to_camera, view.camera.K, view.load_image(),
                                                        view.load_mask())]
        return digest_of(digest_array(array).encode() for array in (*arrays, self.initial, self.truth)
                         if array is not None)

    @cached_property
    def fitted_to_initial(self) -> list[View]:
        """Held-out photos with the pose that fits the initial depth: found once for all settings."""
        return [fitted_poses(other, self.target, [self.initial])[0] for other in self.held_out]

    @cached_property
    def true_normals(self) -> np.ndarray:
        """Of the truth, as compare_depth takes them: found once for all settings."""
        camera = self.target.camera
        return central_normals(sized(self.truth, camera, "true depth map"), camera)

    @cached_property
    def parallax(self) -> np.ndarray:
        """Depth of one pixel of parallax, float64 (H, W), 0 = unknown."""
        return depth_per_parallax(self.initial, self.target.camera, [view.camera for view in self.contexts])


def make_cases(views: list[View], depths, *, truth=None, names=None, sample: int = 1, held_out=None,
               most_contexts: int = 10) -> list[BenchmarkCase]:
    """Cases from the views of a scene; `depths` and `truth` as in `tradeoff`.

    `names`: views to measure on, by default `sample` of those with a depth (and truth), evenly spread, that can be
    judged; `held_out`: names of views that no setting may see, by default two well-placed ones of each target with six
    context views or more, one where there are fewer and no truth.
    """
    if sample < 1:
        raise InputError(f"the number of views to measure on (sample) is {sample}, expected 1 or more")
    views = checked_views("views", views)
    depths = depth_maps(views, depths)
    truth = [None] * len(views) if truth is None else depth_maps(views, truth)
    known = [view.name for view in views]
    banned = {place_of(name, known) for name in held_out or ()}
    # a held-out view is no context view of any target; the chooser may not see it
    usable = [depth if k not in banned else None for k, depth in enumerate(depths)]
    targets = _targets(usable, truth, sample) if names is None else [place_of(name, known) for name in names]
    both = banned.intersection(targets)
    if both:
        raise InputError(f"view {known[min(both)]!r} is to be measured on (--views, names) and held out, expected one "
                         "of them")
    most = sample if names is None else len(targets)
    chooser = ContextChooser([view.camera for view in views], depths, Context(number=most_contexts + 2 + len(banned)))
    cases, stems = [], file_stems(known)
    for k in targets:
        if len(cases) == most:
            break
        if depths[k] is None:
            raise InputError(f"view {views[k].name!r} has no initial depth map to measure on")
        chosen = [j for j in chooser.choose(k).indices if j not in banned]
        spared = [chosen[place] for place in _HELD_OUT_PLACES] if len(chosen) >= 6 else []
        if not spared and truth[k] is None and len(chosen) > 1:
            spared = [chosen[1]]
        kept_out = spared if held_out is None else sorted(banned)
        contexts = [j for j in chosen if j not in kept_out][:most_contexts]
        if not contexts:
            log.warning("view %s has no usable context view and is left out", views[k].name)
            continue
        if truth[k] is None and not kept_out:
            log.warning("view %s cannot be judged and is left out: no truth, no photo to spare", views[k].name)
            continue
        cases.append(BenchmarkCase(stems[k], views[k], [views[j] for j in contexts], [views[j] for j in kept_out],
                                   depths[k], truth[k]))
    if not cases:
        raise InputError("no view can be measured on: none has an initial depth map (of a mesh: one that is not too "
                         "small to show, in the cameras' unit), a usable context view, and a judge (its truth, or "
                         "another usable view to hold out)")
    return cases


def _targets(depths, truth, sample: int) -> list[int]:
    """Views with a depth, and with truth where any has it: `sample` of them, evenly spread, and then the others."""
    have = [k for k, depth in enumerate(depths) if depth is not None and np.any(depth > 0)]
    have = [k for k in have if truth[k] is not None] or have
    places = np.unique(np.linspace(0, len(have) - 1, min(sample, len(have))).round().astype(int)) if have else []
    first = [have[k] for k in places]
    return first + [k for k in have if k not in first]


def loaded(case: BenchmarkCase) -> BenchmarkCase:
    """The case with its photos in memory, so that no file is read while something is timed."""
    target, *others = (replace(view, image=view.load_image(), mask=view.load_mask())
                       for view in (case.target, *case.contexts, *case.held_out))
    number = len(case.contexts)
    return replace(case, target=target, contexts=others[:number], held_out=others[number:])


def score(case: BenchmarkCase, depth: np.ndarray) -> dict[str, float]:
    """Errors of `depth` against the truth where there is one, and how well it predicts the held-out photos.

    With truth: "depth", "depth_median" (scene units), "parallax" (pixels), "normal" (degrees), away from
    discontinuities; "edges": mean depth error within 3 pixels of them; "missing": share of the true pixels. With
    held-out photos, each with the pose that fits it to the depth: "unpredicted" and "unpredicted_mean": 1 - median and
    1 - mean correlation of 7x7 patches, mean over photos; "..._before": of the initial depth there.
    """
    scores = {}
    if case.truth is not None:
        found = compare_depth(depth, case.truth, case.target.camera, parallax=case.parallax,
                              true_normals=case.true_normals, mask=case.target.load_mask())
        smooth, whole = found.smooth, found.all
        scores = {"depth": smooth.mean, "depth_median": smooth.median, "parallax": smooth.mean_parallax,
                  "normal": smooth.normal_mean, "edges": found.edges.mean,
                  "missing": whole.missing / max(1, whole.pixels + whole.missing)}
    pairs = [compare_predictions(case.target, [case.initial, depth],
                                 [start, fitted_poses(other, case.target, [depth])[0]])
             for other, start in zip(case.held_out, case.fitted_to_initial)]
    rows = [(1 - after.median, 1 - after.mean, 1 - before.median, 1 - before.mean) for before, after in pairs
            if after.pixels]
    if rows:
        names = "unpredicted", "unpredicted_mean", "unpredicted_before", "unpredicted_mean_before"
        scores |= zip(names, np.mean(rows, axis=0).tolist())
    return scores


@dataclass(frozen=True, eq=False)
class Outcome:
    depth: np.ndarray    # (H, W), float32
    view_steps: float    # full-size steps of the setting times its context views
    device_bytes: int    # most that was taken, photos included


@dataclass(frozen=True)
class Setting:
    name: str
    config: Config
    group: str = ""

    @property
    def contexts(self) -> int:
        return self.config.context.number

    @property
    def key(self) -> str:
        """The same for equal settings and results, whatever they are called."""
        return key_of(self.config.as_dict())

    def limited(self, contexts: int) -> "Setting":
        """What it is where there are only `contexts` context views."""
        each = views_of_step(self.config, contexts)
        return self.changed(context__number=min(self.contexts, contexts), solver__views_per_step=each)

    def shortened(self) -> "Setting":
        """The same with at most a step a level, which compiles and uploads all that it needs."""
        return self.changed(pyramid__steps=tuple(min(1, n) for n in self.config.pyramid.steps))

    def changed(self, **settings) -> "Setting":
        """The same with other settings, named as in Config.with_settings."""
        return replace(self, config=self.config.with_settings(**settings))

    def outcome(self, case: BenchmarkCase, device, photos) -> Outcome:
        """Refine the target of `case` with its first context views."""
        return self.refined(case.target, case.contexts, surface_depth(case.initial), device, photos)

    def refined(self, target, contexts, depth, device, photos) -> Outcome:
        """Refine `depth` of `target` with the first of `contexts`, effects measured, as a user does one view."""
        contexts = contexts[:self.contexts]
        found = refine_depth(target, contexts, depth, config=self.config, device=device, photos=photos)
        return Outcome(found.depth, view_steps(self.config, len(contexts)), found.report["device_bytes"])

    def seconds(self, cost: Cost, case: BenchmarkCase) -> float:
        """How long that will take by `cost`, that of the preset "balanced", whose kernels do other work."""
        config, contexts = self.config, len(case.contexts)
        factor = (1 + 2 * round(config.splatting.radius))**2 / 9 * (4.0 if config.splatting.blend == "alpha" else 1.0)
        factor *= 0.7 if config.loss.grey else 1.0
        cost = replace(cost, step=cost.step * views_of_step(config, contexts))
        return factor * cost.seconds(config, case.pixels, contexts)


def key_of(described) -> str:
    """A short text that differs where what `described` (for JSON) says differs, or results of this version do."""
    return hashlib.sha256(json.dumps([results_version(), described], sort_keys=True).encode()).hexdigest()[:16]


def fixed(name: str) -> Config:
    """A preset without the measuring of effects: its settings hold as they are."""
    return replace(preset(name), effects=Effects.every("set"))


def distinct(settings: list[Setting], contexts: int) -> list[Setting]:
    """Without those that are the same as an earlier one where there are only `contexts` context views."""
    first: dict[str, Setting] = {}
    for setting in settings:
        first.setdefault(setting.limited(contexts).key, setting)
    return list(first.values())


def front_plan() -> list[Setting]:
    """The plan of `pagas-cl tradeoff`, most informative first, so that a short budget still gives a front: the presets;
    other numbers of steps, each with the rate that suits it, in colour and grey ("fast"); and of context views."""
    color, grey = fixed("balanced"), fixed("fast")
    presets = [Setting(name, preset(name), "preset") for name in ("balanced", "fast", "accurate", "paper")]
    steps = [Setting(f"{'grey, ' * (base is grey)}{n} steps", base.with_settings(
                         pyramid__steps=(n,), solver__rate=rate, solver__beta1=beta1), "steps")
             for base, n, rate, beta1 in (
                 (color, 35, 0.08, 0.9), (color, 50, 0.07, 0.9), (color, 75, 0.06, 0.9),
                 (grey, 30, 0.1, 0.7), (grey, 50, 0.07, 0.9), (grey, 100, 0.045, 0.9),
                 (color, 100, 0.045, 0.9), (color, 200, 0.03, 0.9), (color, 400, 0.02, 0.9), (color, 1000, 0.006, 0.9),
                 (color, 20, 0.1, 0.9), (grey, 6, 0.2, 0.7), (grey, 12, 0.16, 0.7))]
    views = [Setting(f"{n} context view{'s' * (n > 1)}", color.with_settings(context__number=n), "context views")
             for n in (1, 2, 3, 5, 7, 15)]
    return distinct(presets + steps + views, 10**4)


def run(setting: Setting, case: BenchmarkCase, device, photos, repeats: int = 1) -> tuple[Outcome, float]:
    """Run `setting` on `case`, after a run of a step a level that compiles and uploads.

    The seconds, median of the repeats: from photos on the device to depth on the host, effects measured, not compiling.
    """
    setting.shortened().outcome(case, device, photos)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        outcome = setting.outcome(case, device, photos)
        times.append(time.perf_counter() - start)
    return outcome, float(np.median(times))


class Guess:
    """How long a run and its judging will take: by its work, corrected by how long the ones before it took."""

    def __init__(self, case: BenchmarkCase, device, repeats: int):
        given = ViewInput(case.target, case.contexts, case.initial, device, PhotoStore(device))
        self.cost = probe(given, preset("balanced"))
        self.repeats, self.factor = repeats, 1.3

    def seconds(self, setting: Setting, case: BenchmarkCase) -> float:
        judging = 1e-6 * case.pixels * (1 + len(case.held_out))
        return self.factor * (setting.seconds(self.cost, case) * self.repeats + judging + 0.5)

    def learn(self, setting: Setting, case: BenchmarkCase, seconds: float) -> None:
        ratio = self.factor * seconds / self.seconds(setting, case)
        self.factor = 0.8 * self.factor + 0.2 * min(10.0, max(0.1, ratio))
