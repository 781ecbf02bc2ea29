"""Settings on cases, one record after the other: resumable, within a budget."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from pagas_cl.errors import DeviceError, InputError
from pagas_cl.presets import preset
from pagas_cl.tradeoffs.book import Book
from pagas_cl.tradeoffs.case import BenchmarkCase, loaded, make_cases
from pagas_cl.tradeoffs.front import Point, pareto, rank_correlation, summarise
from pagas_cl.tradeoffs.judges import Judges
from pagas_cl.tradeoffs.plan import Setting, distinct, front_plan
from pagas_cl.tradeoffs.run import run
from pagas_cl.tradeoffs.score import score

log = logging.getLogger("pagas_cl")


@dataclass(frozen=True, eq=False)
class Study:
    """What was measured.

    Attributes
    ----------
    points : list of Point
        Cheapest first; those of the front are marked.
    figure : str
        The error that the front is of: "depth" where there is truth, else "unpredicted".
    initial : dict
        Errors of each case's initial depth.
    proxy : float
        Rank correlation of "unpredicted" (held-out photos) with "depth" over the settings; nan without both.
    device : str
    left_out : list of str
        Settings for which the budget did not suffice.
    records : list of dict
        Every run.
    """

    points: list[Point]
    figure: str
    initial: dict
    proxy: float
    device: str
    left_out: list[str] = field(default_factory=list)
    records: list[dict] = field(default_factory=list, repr=False)

    @property
    def front(self) -> list[Point]:
        return [point for point in self.points if point.on_front]


def tradeoff(views, depths, *, truth=None, names=None, held_out=None, sample: int = 1, budget=None, settings=None,
             device=None, report=None, repeats: int = 1, workers: int = 0, progress=None) -> Study:
    """Measure error against time of many settings on a sample of a scene's views.

    Parameters
    ----------
    views : list of View
    depths : list of (ndarray of shape (H, W) or None)
        Initial depth of each view, z-depth in scene units, 0 = no surface.
    truth : list of (ndarray or None), optional
        True depth of each view; without it held-out photos are the judge.
    names, held_out, sample
        Views to measure on, views kept out of everything, or how many views to take: see `make_cases`.
    budget : float, optional
        Minutes; settings that do not fit any more are left out.
    settings : list of Setting, optional
        `front_plan()` by default.
    report : path, optional
        Folder for tradeoff.json, the plot and the page. A study that finds its own earlier records there goes on
        where that one ended.
    repeats : int
        Timed runs of each setting; the median counts.
    workers : int
        Processes that judge results while the device goes on; 0 judges in this one, which leaves the processor to the
        device.
    """
    most = max(setting.contexts for setting in settings or front_plan())
    cases = make_cases(views, depths, truth=truth, names=names, held_out=held_out, sample=sample,
                           most_contexts=most)
    return measure(cases, settings, budget=budget, device=device, report=report, repeats=repeats, workers=workers,
                   progress=progress)


def measure(cases: list[BenchmarkCase], settings: list[Setting] | None = None, *, budget=None, device=None, report=None,
            repeats: int = 1, workers: int = 0, progress=None) -> Study:
    """As `tradeoff`, on cases that are made already."""
    from pagas_cl.runtime.device import open_device

    most = max(len(case.contexts) for case in cases)
    settings, device = distinct(settings or front_plan(), most), open_device(device)
    if budget is not None and not budget > 0:
        raise InputError(f"the budget is {budget!r} minutes, expected more than 0")
    cases = [loaded(case) for case in cases]
    book = Book(None if report is None else Path(report), device.info.title)
    initial = {case.name: score(case, case.initial) for case in cases}
    left_out = _fill(book, cases, settings, device, budget, repeats, workers, progress)
    study = collect(book.records, settings, initial, str(device.info), left_out)
    if report is not None:
        from pagas_cl.tradeoffs.page import write_report

        write_report(Path(report), study, book.as_dict(study))
    return study


def collect(records, settings, initial: dict, device: str, left_out=()) -> Study:
    """The study that `records` make of `settings` on the cases that `initial` names (a part of them, say)."""
    points = summarise(settings, records, initial, list(initial))
    figure = "depth" if all("depth" in scores for scores in initial.values()) else "unpredicted"
    points = sorted(points, key=lambda p: p.seconds)
    marks = pareto([p.seconds for p in points], [p.error(figure) for p in points]) if points else []
    proxy = rank_correlation(*([p.error(which) for p in points] for which in ("depth", "unpredicted")))
    return Study([replace(p, on_front=bool(mark)) for p, mark in zip(points, marks)], figure, initial, proxy,
                 device, list(left_out), list(records))


def _fill(book, cases, settings, device, budget, repeats, workers, progress) -> list[str]:
    """Run what the book does not have; returns the names of what did not fit into the budget."""
    began, left_out = time.monotonic(), []
    todo = [(setting, k) for setting in settings for k, case in enumerate(cases) if not book.has(setting, case)]
    guess = _Guess(cases[0], device, repeats) if todo else None
    if todo:
        log.info("%d settings on %d views, %d runs still to do: about %.1f minutes%s", len(settings), len(cases),
                 len(todo), sum(guess.seconds(setting, cases[k]) for setting, k in todo) / 60,
                 f", at most {budget:g}" if budget else "")
    with Judges(cases, workers) as judges:
        for done, (setting, k) in enumerate(todo):
            if progress:
                progress("measure", done, len(todo))
            spent = time.monotonic() - began
            if budget and spent + guess.seconds(setting, cases[k]) > 60 * budget:
                left_out.append(setting.name)
                continue
            _one(book, setting, cases[k], k, device, repeats, judges, guess)
    if progress:
        progress("measure", len(todo), len(todo))
    if left_out:
        log.warning("left out, since the budget of %g minutes would not do: %s", budget,
                    "; ".join(dict.fromkeys(left_out)))
    return list(dict.fromkeys(left_out))


def _one(book, setting, case, number, device, repeats, judges, guess):
    """Run one setting on one view, have it judged, and write it into the book."""
    from pagas_cl.splat import PhotoStore

    start, photos = time.monotonic(), PhotoStore(device)  # its own: the memory counted is of this view alone
    record = {"key": setting.key, "setting": setting.name, "case": case.name}
    try:
        outcome = run(setting, case, device, photos, repeats)
    except DeviceError as error:  # too much memory for this device: the others still go
        log.warning("%s on %s: %s", setting.name, case.name, error)
        book.add({**record, "error": str(error)})
        return
    record |= {"seconds": outcome.seconds, "view_steps": outcome.view_steps, "device_bytes": outcome.device_bytes,
               "pixels": case.pixels}
    judges.judge(number, outcome.depth, lambda scores: book.add({**record, "scores": scores}))
    guess.learn(setting, case, time.monotonic() - start)


class _Guess:
    """How long a run will take: by its work, corrected by how long the ones before it took."""

    def __init__(self, case, device, repeats):
        from pagas_cl.costs import photo_seconds, probe

        self.cost = probe(case.target, case.contexts, case.initial, preset("balanced"), device,
                          photo=photo_seconds((case.target,), device))
        self.repeats, self.factor = max(1, repeats), 1.3

    def seconds(self, setting, case) -> float:
        return self.factor * self._seconds(setting, case)

    def _seconds(self, setting, case) -> float:
        total = 0.0
        for stage in setting.stages:
            size = 1 + 2 * round(stage.splatting.radius)
            factor = size**2 / 9 * (4.0 if stage.splatting.blend == "alpha" else 1.0)
            factor *= 0.7 if stage.loss.grey else 1.0
            total += factor * self.cost.seconds(stage, case.pixels, len(case.contexts))
        judging = 1e-6 * case.pixels * (1 + len(case.held_out))
        return total * self.repeats * (1 + 2 * setting.agree) + judging + 0.5

    def learn(self, setting, case, seconds: float):
        self.factor = 0.8 * self.factor + 0.2 * min(10.0, max(0.1, seconds / self._seconds(setting, case)))
