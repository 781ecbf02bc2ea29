"""What a run gained and did, in a sentence each, and one bar."""

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

STATUS = ("refined", "kept", "rejected")   # of pixels with a surface
NOT_MEASURED = ("Whether photos agree better was not measured, since every photo took part: keep some out with "
                "--hold-out, and compare with 'pagas-cl evaluate --held-out'.")


def shares(row: dict) -> dict[str, float]:
    """Shares of the pixels with a surface, 0 to 1, of a view's counts; empty without any."""
    total = sum(row.get(name, 0) for name in STATUS)
    return {name: row[name] / total for name in STATUS if name in row} if total else {}


def summed(rows: list[dict]) -> dict[str, int]:
    """Pixels of all views."""
    return {name: sum(row.get(name, 0) for row in rows) for name in (*STATUS, "no surface")
            if any(name in row for row in rows)}


def sentence(rows: list[dict], reasons: list[str], stopped: str = "") -> str:
    """What became of the views `rows`, of which those with a reason (not "") stay unchanged; where most of the surface
    does, what to do."""
    done = f"{len(rows)} view{'s' * (len(rows) != 1)}"
    if stopped:
        done += f" (the run ended with: {stopped})"
    returned = [reason for reason in reasons if reason]
    share = shares(summed(rows))
    if not rows:
        return f"Nothing was refined: the run ended before a view was done, with: {stopped}." if stopped else ""
    if not share:
        return f"Nothing was refined: {done}, none with a surface to start from."
    if not share.get("refined"):
        often = Counter(returned).most_common(1)
        return f"Nothing was refined: {done}, all unchanged" + (f" ({often[0][0]})." if often else ".")
    moves = [(row["median change (px)"], row["95% change (px)"]) for row in rows
             if row.get("refined") and "median change (px)" in row]
    text = f"The photos refined {share['refined']:.1%} of the surface in {done}."
    if moves:
        half, most = np.median(moves, axis=0)
        text += f" Half of it moved by more than {half:.2g} pixels as other photos see it, 5% by more than {most:.2g}."
    if returned:
        text += (f" {len(returned)} of the views {'stays' if len(returned) == 1 else 'stay'} unchanged "
                 f"({Counter(returned).most_common(1)[0][0]}).")
    if share["refined"] < 0.5:
        text += (" Most of the surface stays unchanged: check cameras and photos with 'pagas-cl check', or add photos "
                 "of it from places nearby.")
    return text


def proof(reports: Sequence[dict[str, Any]], reasons: Sequence[str]) -> str:
    """Whether photos that took no part in refining a view agree better through its refined depth, and on how many
    views, from the `reports` of DepthResults; a view with a reason (not "") stays as it was."""
    pairs = [(before, before if reason else after) for report, reason in zip(reports, reasons)
             for before, after in _judged(report.get("held_out_costs", ()))]
    if not pairs:
        return NOT_MEASURED if any(reports) else ""
    text = agreement(pairs)
    small = [report["smaller_sizes"] for report in reports if "smaller_sizes" in report]
    at_first = [pair for size in small for pair in _judged(size["held_out_costs"])]
    if at_first:
        before, after = np.median(at_first, axis=0)
        text += f" Smaller sizes came before that: {before:.3g} to {after:.3g} at {small[0]['scale']:g} of the size."
    return text


def _judged(costs: Iterable[Sequence[float | None]]) -> list[tuple[float, float]]:
    """Mean before and after over the photos that see a view; nothing where none does."""
    seen = np.array([pair for pair in costs if None not in pair], np.float64).reshape(-1, 2)
    seen = seen[np.isfinite(seen).all(axis=1)]
    return [tuple(seen.mean(axis=0).tolist())] if len(seen) else []


def agreement(pairs: Sequence[tuple[float, float]], of: str = "view") -> str:
    """The sentence of (before, after), 1 - correlation of photos that took no part, one pair a view, or of what else
    they are."""
    before, after = np.median(pairs, axis=0)
    better, worse = (sum(sign * (a - b) > 0 for b, a in pairs) for sign in (-1, 1))
    verdict = ("Photos that took no part agree better" if after < before else
               "Nothing was gained: photos that took no part agree no better" if not worse and after == before else
               "Photos that took no part agree worse")
    return (f"{verdict}: {before:.3g} before, {after:.3g} after (1 - correlation, median of {len(pairs)} "
            f"{of}{'s' * (len(pairs) != 1)}; better on {better}, worse on {worse}).")


def bar(rows: list[dict]) -> str:
    """HTML of the shares of all views."""
    share = shares(summed(rows))
    if not share:
        return ""
    parts = "".join(f'<i class="{name}" style="flex:{part:.4f}"></i>' for name, part in share.items() if part)
    keys = "".join(f'<span><i class="{name}"></i>{escape(name)} {part:.1%}</span>' for name, part in share.items())
    return f'<div class="shares">{parts}</div><div class="keys">{keys}</div>'
