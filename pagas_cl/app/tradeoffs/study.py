"""Settings on cases, one record after the other in tradeoff.json: resumable, within a budget; and the Pareto front."""

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pagas_cl.app.tradeoffs.case import (
    BenchmarkCase,
    Guess,
    Setting,
    distinct,
    front_plan,
    loaded,
    make_cases,
    run,
    score,
)
from pagas_cl.app.tradeoffs.page import FILE, write_report
from pagas_cl.errors import DeviceError, InputError, log
from pagas_cl.jobs.work_folder import one_run
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.view.prediction import PATCH
from pagas_cl.progress import Reporter, progress_of, stage
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.own_files import write_json
from pagas_cl.system.files import DAMAGE, read_bytes, translated


@dataclass(frozen=True)
class Point:
    """One setting over all the cases that it ran on.

    `seconds` and `view_steps` are means per view, `device_bytes` the most of any view. `errors`: mean over the views of
    each of case.score's figures as a share of the initial depth's; "missing" as it is.
    """

    name: str
    group: str
    seconds: float
    device_bytes: int
    view_steps: float
    errors: dict
    views: int
    on_front: bool = False

    def error(self, which: str) -> float:
        return self.errors.get(which, float("nan"))


@dataclass(frozen=True, eq=False)
class Study:
    """What was measured.

    `figure` is the error that the front is of: "depth" where there is truth, else "unpredicted" (held-out photos).
    """

    points: list[Point]         # cheapest first; those of the front are marked
    figure: str
    initial: dict               # errors of each case's initial depth
    device: str
    left_out: list[str] = field(default_factory=list)               # names: the budget did not suffice
    records: list[dict] = field(default_factory=list, repr=False)   # every run


def tradeoff(views, depths, *, truth=None, names=None, held_out=None, sample: int = 1, budget=None, settings=None,
             device=None, report=None, repeats: int = 1, progress: Reporter = None) -> Study:
    """Measure error against time of many settings on a sample of a scene's views.

    `depths`, `truth`: initial and true depth of each view, arrays (H, W) of z-depth in scene units, 0 = none, or None;
    without truth held-out photos are the judge. `names`, `held_out`, `sample`: views to measure on, views kept out of
    everything, or how many views to take, see `make_cases`. `budget`: minutes; `settings` (by default `front_plan()`)
    that do not fit any more are left out. `report`: folder for tradeoff.json, the plot and the page; a study that finds
    its own earlier records there goes on from them. `repeats`: timed runs of each setting; the median counts.
    """
    most = max(setting.contexts for setting in settings or front_plan())
    cases = make_cases(views, depths, truth=truth, names=names, held_out=held_out, sample=sample, most_contexts=most)
    return measure(cases, settings, budget=budget, device=device, report=report, repeats=repeats, progress=progress)


def measure(cases: list[BenchmarkCase], settings: list[Setting] | None = None, *, budget=None, device=None, report=None,
            repeats: int = 1, progress: Reporter = None) -> Study:
    """As `tradeoff`, on cases that are made already."""
    most = max(len(case.contexts) for case in cases)
    settings, device = distinct(settings or front_plan(), most), open_device(device)
    if budget is not None and not budget > 0:
        raise InputError(f"the budget is {budget!r} minutes, expected more than 0")
    if repeats < 1:
        raise InputError(f"the number of timed runs of a setting (repeats) is {repeats}, expected 1 or more")
    cases = [loaded(case) for case in cases]
    cases, initial = _judged(cases)
    with one_run(report):
        book = Book(None if report is None else Path(report), device.info.title, cases)
        left_out = _fill(book, cases, settings, device, budget, repeats, progress_of(progress))
        study = collect(book.records, settings, initial, str(device.info), left_out)
        if report is not None and study.points:
            write_report(Path(report), study, book.device)
    return study


def _judged(cases: list[BenchmarkCase]) -> tuple[list[BenchmarkCase], dict]:
    """The cases whose initial depth has an error that others can be a share of, and all its errors."""
    scores = {case.name: score(case, case.initial) for case in cases}
    judged = [case for case in cases if any(scores[case.name].get(name, 0) > 0 for name in ("depth", "unpredicted"))]
    for case in cases:
        if case not in judged:
            log.warning("%s cannot be judged and is left out: no truth lies where its initial depth does, and is not "
                        "the same, and no held-out photo sees a textured patch of %d x %d pixels of it", case.name,
                        PATCH, PATCH)
    if not judged:
        raise InputError("no view can be judged: give truth that lies where its initial depth does and is not the "
                         "same, hold out photos that see what is measured, give more views, or larger photos of a "
                         "small thing")
    return judged, {case.name: scores[case.name] for case in judged}


def collect(records, settings, initial: dict, device: str, left_out=()) -> Study:
    """The study that `records` make of `settings` on the cases that `initial` names (a part of them, say)."""
    points = sorted(summarise(settings, records, initial), key=lambda p: p.seconds)
    figure = "depth" if all(scores.get("depth", 0) > 0 for scores in initial.values()) else "unpredicted"
    marks = pareto([p.seconds for p in points], [p.error(figure) for p in points])
    return Study([replace(p, on_front=bool(mark)) for p, mark in zip(points, marks)], figure, initial, device,
                 list(left_out), list(records))


def summarise(settings, records, initial: dict) -> list[Point]:
    """Points of the settings that ran on all cases of `initial`: the name of each -> scores of its initial depth."""
    points = []
    for setting in settings:
        rows = {r["case"]: r for r in records if r["key"] == setting.key and r["case"] in initial and "error" not in r}
        if len(rows) == len(initial):
            seconds, steps = (float(np.mean([r[name] for r in rows.values()])) for name in ("seconds", "view_steps"))
            points.append(Point(setting.name, setting.group, seconds,
                                max(r["device_bytes"] for r in rows.values()), steps, _errors(rows, initial),
                                len(rows)))
    return points


def _errors(rows, initial) -> dict[str, float]:
    shares: dict[str, list[float]] = {}
    for case, row in rows.items():
        scores = {name: float("nan") if value is None else value for name, value in row["scores"].items()}  # JSON: null
        before = {**initial[case], **{name.removesuffix("_before"): value for name, value in scores.items()
                                      if name.endswith("_before")}, "missing": 1.0}
        for name, value in scores.items():
            if not name.endswith("before") and before.get(name):
                shares.setdefault(name, []).append(value / before[name])
    return {name: float(np.mean(values)) for name, values in shares.items() if len(values) == len(rows)}


def pareto(costs, errors) -> np.ndarray:
    """Which points no other one beats: no cheaper or equal one has a smaller error. bool (n,)."""
    costs, errors = np.asarray(costs, float), np.asarray(errors, float)
    front, best = np.zeros(len(costs), bool), np.inf
    for k in np.lexsort((errors, costs)):
        if errors[k] < best:
            front[k], best = True, errors[k]
    return front


def _checked(record: dict) -> dict:
    """A record of tradeoff.json with all that it must have; one of DAMAGE or TypeError where it has not."""
    if not ({"key", "setting", "case"} <= record.keys() and all(isinstance(record[k], str) for k in ("key", "case"))):
        raise ValueError("a run has no key or case")
    if "error" not in record:
        figures = [record[name] for name in ("seconds", "view_steps", "device_bytes")]
        if not all(isinstance(figure, (int, float)) for figure in (*figures, *record["scores"].values())):
            raise ValueError(f"the figures of {record['case']} are no numbers")
    return record


class Book:
    """Records of runs on `device`, in `folder`'s tradeoff.json (None: in memory), which is whole at any time.

    An interrupted study goes on where it ended; one of another device, or of none of the `cases`, is not added to.
    """

    def __init__(self, folder: Path | None, device: str, cases: list[BenchmarkCase]):
        self.path, self.device, self.records = folder and folder / FILE, device, []
        if self.path is not None and self.path.is_file():
            with translated(f"{str(self.path)!r} is no record of a study (", "); move it away",
                            (*DAMAGE, TypeError, AttributeError)):
                kept = json.loads(read_bytes(self.path))
                self.records = [_checked(record) for record in kept["records"]]
                other = self._other(kept["device"], {case.name: case.digest for case in cases})
            if self.records and other:
                raise InputError(f"{str(self.path)!r} is a study {other}, which this one would be mixed with: choose "
                                 "another folder, or move it away")
            log.info("%s: %d runs are there already", self.path, len(self.records))

    def _other(self, device: str, digests: dict[str, str]) -> str:
        """In words, what the records are of where they are not of this study."""
        names = {record["case"]: record.get("digest") for record in self.records}     # none before 0.2
        if device != self.device:
            return f"on {device}, not on {self.device}"
        if not names.keys() & digests.keys():
            return f"of other views ({', '.join(names)})"
        changed = [name for name, digest in names.items() if digest not in (None, digests.get(name, digest))]
        return (f"with another photo, camera, depth or truth of {changed[0]}, or of the views around it" if changed
                else "")

    def has(self, setting: Setting, case: BenchmarkCase) -> bool:
        return any((record["key"], record["case"]) == (setting.key, case.name) for record in self.records)

    def add(self, record: dict) -> None:
        self.records.append(record)
        if self.path is not None:
            write_json(self.path, "tradeoff", {"device": self.device, "records": self.records})


def _fill(book, cases, settings, device, budget, repeats, progress) -> list[str]:
    """Run what the book does not have; returns the names of what did not fit into the budget."""
    todo = [(setting, case) for setting in settings for case in cases if not book.has(setting, case)]
    if not todo:
        return []
    guess = Guess(cases[0], device, repeats)
    log.info("%d settings on %d views, %d runs still to do: about %.3g minutes%s", len(settings), len(cases), len(todo),
             sum(guess.seconds(*pair) for pair in todo) / 60, f", at most {budget:g}" if budget else "")
    began, left_out, done = time.monotonic(), {}, 0     # what the guess has built and timed is of use to all settings
    with stage(progress, "measure", len(todo)) as measuring:
        for setting, case in todo:
            started = time.monotonic()
            if budget and started - began + guess.seconds(setting, case) > 60 * budget:
                left_out[setting.name] = True
                continue
            record = _record(setting, case, device, repeats)
            if "scores" in record:
                guess.learn(setting, case, time.monotonic() - started)
            book.add(record)
            done += 1
            measuring.advance(done)
    if left_out:
        log.warning("left out, since the budget of %g minutes would not do: %s", budget, "; ".join(left_out))
    return list(left_out)


def _record(setting, case, device, repeats) -> dict:
    """What is written down of one run: its figures, or the "error" where the device could not do it."""
    record = {"key": setting.key, "setting": setting.name, "case": case.name, "digest": case.digest}
    try:  # photos of its own: the memory counted is of this view alone
        outcome, seconds = run(setting, case, device, PhotoStore(device), repeats)
    except DeviceError as error:  # too much memory for this device: the others still go
        log.warning("%s on %s: %s", setting.name, case.name, error)
        return {**record, "error": str(error)}
    return {**record, "seconds": seconds, "view_steps": outcome.view_steps, "device_bytes": outcome.device_bytes,
            "pixels": case.pixels, "scores": score(case, outcome.depth)}
