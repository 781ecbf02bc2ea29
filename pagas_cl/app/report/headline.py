"""What a run did, in one sentence and one bar."""

from collections import Counter
from html import escape

import numpy as np

STATUS = ("refined", "kept", "rejected")   # of pixels with a surface


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
    moves = [np.median([row[name] for row in rows if name in row and row.get("refined")])
             for name in ("median change (px)", "95% change (px)")
             if any(name in row and row.get("refined") for row in rows)]
    text = f"The photos refined {share['refined']:.1%} of the surface in {done}."
    if len(moves) == 2:
        text += (f" Half of it moved by more than {moves[0]:.2g} pixels as other photos see it, 5% by more than "
                 f"{moves[1]:.2g}.")
    if returned:
        text += (f" {len(returned)} of the views {'stays' if len(returned) == 1 else 'stay'} unchanged "
                 f"({Counter(returned).most_common(1)[0][0]}).")
    if share["refined"] < 0.5:
        text += (" Most of the surface stays unchanged: check cameras and photos with 'pagas-cl check', or add photos "
                 "of it from places nearby.")
    return text


def bar(rows: list[dict]) -> str:
    """HTML of the shares of all views."""
    share = shares(summed(rows))
    if not share:
        return ""
    parts = "".join(f'<i class="{name}" style="flex:{part:.4f}"></i>' for name, part in share.items() if part)
    keys = "".join(f'<span><i class="{name}"></i>{escape(name)} {part:.1%}</span>' for name, part in share.items())
    return f'<div class="shares">{parts}</div><div class="keys">{keys}</div>'
