"""`pagas-cl analyze`: which effects a scene needs, on what evidence, and what each costs on this device."""

import sys
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from textwrap import wrap

import numpy as np
import typer

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._given import look
from pagas_cl.app.commands._outputs import check_outputs
from pagas_cl.app.commands._process import opened_device, shown_progress
from pagas_cl.app.tradeoffs.costs import full_steps
from pagas_cl.config import Config
from pagas_cl.config.presets import build_config, effect_settings, preset
from pagas_cl.errors import plain
from pagas_cl.method.cameras.effect import FEWEST, MOST, camera_seconds, decide_cameras
from pagas_cl.method.effects.decide import EFFECTS, Decision, decide, decide_consistency, resolve_effects
from pagas_cl.method.effects.measure import Measurements
from pagas_cl.method.splat import PhotoStore, ViewInput
from pagas_cl.method.splat.level import Schedule
from pagas_cl.method.splat.view import full_level
from pagas_cl.method.view.coarse_to_fine import resolve_pyramid
from pagas_cl.progress import Progress, Reporter, progress_of, reported, stage
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.choice import PartnerChooser
from pagas_cl.scene.inputs import checked_depth, depth_array, depth_maps, requested_views
from pagas_cl.scene.own_files import write_json

WIDTH = 80
_MEASURABLE = 0.03     # share of a view's time, below which a difference is none
_ROUNDS = 3      # timed after one that compiles; the best counts
_STEPS = 5       # of each round, at full size


@dataclass(frozen=True)
class EffectCost:
    """Seconds of all steps of one view with the effect and without it, and the bytes that it takes on the device."""

    on: float
    off: float
    device_bytes: int


@dataclass(frozen=True)
class ViewAnalysis:
    """One view: its context views, the decisions, and what they rest on. `reason`: why there are none."""

    view: str
    contexts: tuple[str, ...]
    decisions: tuple[Decision, ...]
    measured: Measurements | None
    reason: str = ""


@dataclass(frozen=True)
class Analysis:
    """`views`: one entry each; `costs`: by effect, measured on `timed`; `device`: what they were measured on."""

    views: tuple[ViewAnalysis, ...]
    costs: dict[str, EffectCost]
    timed: str
    device: str
    consistency: Decision | None = None
    cameras: Decision | None = None
    pyramid: Decision | None = None

    @property
    def of_scene(self) -> list[Decision]:
        """What is decided of all views at once."""
        return [made for made in (self.pyramid, self.cameras, self.consistency) if made is not None]

    def as_dict(self) -> dict:
        views = [{"view": view.view, "contexts": list(view.contexts), "reason": view.reason,
                  "measured": view.measured.figures if view.measured else {},
                  "effects": [decision.as_dict() for decision in view.decisions]}
                 for view in self.views]
        costs = {name: {"seconds_on": cost.on, "seconds_off": cost.off, "device_bytes": cost.device_bytes}
                 for name, cost in self.costs.items()}
        return {"device": self.device, "timed": self.timed, "costs": costs,
                **{name: getattr(self, name) and getattr(self, name).as_dict()
                   for name in ("consistency", "cameras", "pyramid")}, "views": views}


def analyze(views, depths, *, names=None, config: Config | None = None, device=None, costs: bool = True,
            progress: Reporter = None) -> Analysis:
    """Measure what each view needs; nothing is refined. Parameters as in refine_views, "balanced" by default.

    `costs`: whether to time some steps with each effect on and off, on the first view that has context views.
    """
    config, device = config or preset("balanced"), open_device(device)
    depths = depth_maps(views, depths)
    requested, photos = requested_views(views, depths, names), PhotoStore(device)
    shown = progress_of(progress)
    _, config, pyramid = resolve_pyramid(views, depths, requested, config, lambda: photos, shown)
    chooser = PartnerChooser([view.camera for view in views], depths, config.context)
    found, timed, measured_costs = [], "", {}
    for index in reported(shown, "analyze", requested):
        target, partners = views[index], chooser.choose(index)
        if not partners.contexts:
            found.append(ViewAnalysis(target.name, (), (), None, partners.reason))
            continue
        contexts, depth = [views[k] for k in partners.contexts], checked_depth(depth_array(depths[index]), target)
        given = ViewInput(target, contexts, depth, device, photos)
        with resolve_effects(given, config) as (_, decisions, measured, used):
            found.append(ViewAnalysis(target.name, tuple(v.name for v in contexts), tuple(decisions), measured))
            if costs and not timed:
                timed, few = target.name, (index, *partners.contexts)
                measured_costs = effect_costs(used, config, found[-1], shown)
    with stage(shown, "compare the depth maps", 1) as comparing:
        agreement = decide_consistency([view.camera for view in views], depths, config, device)[1]
        comparing.advance(1)
    cameras = None
    if config.effects.cameras != "set" and FEWEST <= len(views) <= MOST:
        with stage(shown, "measure the cameras", 1) as measuring:
            cameras = decide_cameras(views, depths, config, device)[0]
            if cameras.on and timed:
                measured_costs["cameras"] = EffectCost(camera_seconds(
                    [views[k] for k in few], [depths[k] for k in few], config, device, len(views)), 0.0, 0)
            measuring.advance(1)
    return Analysis(tuple(found), measured_costs, timed, device.info.title, agreement, cameras, pyramid)


def effect_costs(given: ViewInput, config: Config, analysis: ViewAnalysis, progress: Progress) -> dict[str, EffectCost]:
    """Steps of one view with each effect on and off, the others as decided."""
    names = [decision.effect for decision in analysis.decisions]
    decided = config.with_settings(**{f"effects__{made.effect}": "on" if made.on else "off"
                                      for made in analysis.decisions})

    @cache
    def cost(resolved: Config) -> tuple[float, int]:
        seconds, device_bytes = time_step(given, resolved)
        return seconds * full_steps(resolved), device_bytes

    costs = {}
    for name in reported(progress, "time the effects", names):
        on, off = (cost(decide(decided.with_settings(**{f"effects__{name}": choice}), analysis.measured)[0])
                   for choice in ("on", "off"))
        costs[name] = EffectCost(on[0], off[0], on[1] - off[1])
    return costs


def time_step(given: ViewInput, config: Config) -> tuple[float, int]:
    """Seconds of a step at full size, the best mean of some rounds, and bytes on the device without photos."""
    # a level has room for the losses of as many steps as it is made for
    config = config.with_settings(pyramid__scales=(1.0,), pyramid__steps=(_STEPS,))
    level, queue = full_level(given, config), given.device.queue
    without_fits = Schedule.of(config, _STEPS).last_phase_only        # fits are a few of all steps, not of these
    best = np.inf
    for _ in range(1 + _ROUNDS):
        queue.finish()
        start = time.perf_counter()
        level.run(_STEPS, schedule=without_fits)
        queue.finish()
        best = min(best, time.perf_counter() - start)
    needed = sum(buffer.size for buffer in level.buffers.held())
    level.release()
    return best / _STEPS, needed


def command(
    scene: Path = options.SCENE,
    mesh: Path = typer.Option(None, "--mesh", help="The coarse mesh; its depth is where a refinement would start."),
    depth_dir: Path = options.DEPTH_DIR,
    views: list[str] = typer.Option([], "--views", help="Analyze these views only (several names may follow)."),
    table: bool = typer.Option(False, "--table", help="Also one line a view and effect, and the cost of each."),
    output: Path = typer.Option(None, "--json", help="Write everything to this file."),
    preset: str = typer.Option("balanced", "--preset", help="Settings to start from: balanced, accurate, ..."),
    settings: list[str] = typer.Option([], "--set", metavar="STAGE.FIELD=VALUE", help="Change one setting."),
    effects: list[str] = typer.Option([], "--effect", metavar="NAME=auto|on|off|set", help="As in refine."),
    costs: bool = typer.Option(True, "--costs/--no-costs", help="Time some steps with each effect on and off."),
    device: str = options.DEVICE,
    format: str = options.FORMAT,
    depth_scale: float = options.DEPTH_SCALE,
    outside: bool = options.OUTSIDE,
    photos: Path = options.PHOTOS,
    overwrite: bool = options.OVERWRITE,
    quiet: bool = options.QUIET,
):
    """Measure which effects SCENE needs; refines nothing. The decisions are those that refine takes."""
    config = build_config(preset, [*settings, *effect_settings(effects)])
    given = look(scene, mesh=mesh, depth_dir=depth_dir, depth_scale=depth_scale, format=format, outside=outside,
                 photos=photos, names=views)
    check_outputs([("--json", output)], [], given.inputs, overwrite)
    given.log()
    progress = shown_progress(quiet)
    device = opened_device(device)
    depths = given.initial_depths(progress, device)
    analysis = analyze(given.scene.views, depths, names=given.names, config=config, device=device, costs=costs,
                       progress=progress)
    show(analysis, table)
    if output is not None:
        write_json(output, "analyze", analysis.as_dict())


def _table(analysis) -> list[str]:
    """One line a view and effect; a view that has no context view has one line with the reason."""
    def line(view, decision):
        return (f"{view[-29:]:<29} {decision.effect:<16}{decision.evidence:>10.4g}{decision.threshold:>11g}  "
                f"{'on' if decision.on else 'off'}")

    lines = []
    for view in analysis.views:
        if view.reason and not view.decisions:
            lines.append(f"{view.view[-29:]:<29} {view.reason}"[:WIDTH])
        lines += [line(view.view, decision) for decision in view.decisions]
    return lines + [line("all", decision) for decision in analysis.of_scene]


def summary(analysis) -> list[str]:
    """Lines of at most WIDTH columns: which effects are on, in how many views, on what evidence, at what cost."""
    return [line for head, text in _paragraphs(analysis) for line in wrap(
        text, WIDTH, initial_indent=head, subsequent_indent=" " * len(head)) or [""]]


def _paragraphs(analysis) -> list[tuple[str, str]]:
    """What stands at the head of each paragraph of the summary, and its text."""
    decided = [*(decision for view in analysis.views for decision in view.decisions), *analysis.of_scene]
    without, number = sum(bool(view.reason) for view in analysis.views), len(analysis.views)
    lines = [("", f"{number} view{'s' * (number != 1)}" + (f", {without} of them not to be refined (--table says why)"
                                                    if without else ""))]
    for on, what in ((True, "Needed:"), (False, "Not needed:")):
        of = {}
        for decision in decided:
            if decision.on == on:
                of.setdefault(decision.effect, []).append(decision)
        lines += [("", ""), ("", what)] if of else []
        for name, found in of.items():
            total = sum(d.effect == name for d in decided)
            where = f"{len(found)} of {total} view{'s' if total > 1 else ''}" if name in EFFECTS else "scene"
            lines.append((f"  {name:<16}{where:<14} ", _why(found, analysis.costs.get(name))))
    return lines + ([("", ""), ("", f"Costs: of {analysis.timed}, on {analysis.device}.")] if analysis.costs else [])


def _why(decisions, cost: EffectCost | None) -> str:
    """Reason, evidence and threshold of decisions on one effect, and its cost."""
    first, values = decisions[0], sorted(d.evidence for d in decisions if d.evidence == d.evidence)
    effect = EFFECTS.get(first.effect)
    limit = f"on {'below' if effect and not effect.above else 'above'} {first.threshold:g}"
    seen = " to ".join(dict.fromkeys(map(number, (values[0], values[-1])))) if values else "not measured"
    why = f"{first.reason}: {seen} ({limit})"
    if cost is None:
        return why
    more = cost.on - cost.off
    time = f"{seconds(more)} a view" if more > _MEASURABLE * cost.off else "no time to speak of"
    return f"{why}; costs {time}" + (f", {size(cost.device_bytes)}" if cost.device_bytes else "")


def number(value: float) -> str:
    """Three digits, no exponent."""
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.3g}"


def seconds(value: float) -> str:
    return f"{value:.2g} s" if value >= 0.995 else f"{1e3 * value:.0f} ms"


def size(nbytes: float) -> str:
    return f"{nbytes / 1e6:.1f} MB" if abs(nbytes) >= 1e5 else f"{nbytes / 1e3:.0f} kB"


def show(analysis, table: bool = False) -> None:
    """The summary on standard output, and with `table` one line a view and effect, one an effect."""
    lines = summary(analysis)
    if table:
        lines += ["", f"{'view':<29} {'effect':<16}{'evidence':>10}{'threshold':>11}  decision"]
        lines += _table(analysis)
        if analysis.costs:
            lines += ["", f"{'effect':<16}{'without it':>12}{'with it':>12}{'memory':>12}  a view"]
        lines += [f"{name:<16}{seconds(cost.off):>12}{seconds(cost.on):>12}{size(cost.device_bytes):>12}"
                  for name, cost in analysis.costs.items()]
    sys.stdout.write("\n".join(map(plain, [*lines, ""])))
