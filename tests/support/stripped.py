"""Kernel sources as if an effect had never been written: its blocks, its parameters, what is handed to them deleted."""

from __future__ import annotations

import re

from support.effects import EFFECTS

STEP = ("composite.cl", "backward.cl", "ssim.cl", "loss.cl", "smooth.cl", "step.cl", "alpha.cl")   # of every step


def without_blocks(text: str, macros) -> str:
    """`text` without what stands between #ifdef MACRO and its #else or #endif, and without those lines themselves."""
    kept, open_blocks = [], []              # of each open #if: None, or whether its lines are kept
    for line in text.splitlines():
        word = re.match(r"\s*#\s*(ifdef|ifndef|if|elif|else|endif)\b\s*(\w*)", line)
        kind, name = word.groups() if word else ("", "")
        if kind in ("ifdef", "ifndef", "if"):
            open_blocks.append(kind == "ifndef" if name in macros and kind != "if" else None)
            own = open_blocks[-1] is not None
        elif kind in ("else", "endif"):
            own = open_blocks[-1] is not None
            if own and kind == "else":
                open_blocks[-1] = not open_blocks[-1]
            elif kind == "endif":
                open_blocks.pop()
        else:
            own = False
        if not own and False not in open_blocks:
            kept.append(line)
    return "\n".join(kept)


def without_parameters(text: str, names) -> str:
    """`text` without parameters called `names` and without the arguments of the same names."""
    for name in names:
        declared = rf"(?:__global\s+)?(?:const\s+)?(?:volatile\s+)?(?:float|uint|int)\s*\*?\s*\b{name}"
        text = re.sub(rf"{declared}\s*,\s*", "", text)
        text = re.sub(rf",\s*{declared}\s*\)", ")", text)
        text = re.sub(rf"(?<=[(,\s]){name}\s*,\s*", "", text)
        text = re.sub(rf",\s*{name}\s*\)", ")", text)
    return text


def never_had(effect: str, file: str, text: str) -> str:
    """The source `text` of the kernel file `file` (includes pasted) without `effect`."""
    text = re.sub(r"//.*", "", text)          # what a comment says of a parameter is no parameter
    return without_parameters(without_blocks(text, EFFECTS[effect].macros), parameters_in(effect, file))


def parameters_in(effect: str, file: str) -> tuple[str, ...]:
    """Kernel parameters of `file` that serve `effect` alone; a word may mean something else in another file, and what
    is launched for an effect alone (nearest surfaces) needs them."""
    if file not in STEP or (effect == "unseen_mask" and file != "loss.cl"):
        return ()
    return EFFECTS[effect].parameters


def parameters_of(text: str, kernel: str) -> list[str]:
    """Names of the parameters of `kernel`, in order."""
    listed = re.search(rf"__kernel[^(]*(?:\(\([^)]*\([^)]*\)\)\)\s*)?(?:void\s+)?[^(]*\b{kernel}\s*\(([^)]*)\)",
                       re.sub(r"//.*", "", text))[1]
    return [re.findall(r"\w+", one)[-1] for one in listed.split(",")]
