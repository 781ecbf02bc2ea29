"""Which of the views that were chosen for a target take part: those that add to what is known of its depth, by how much
they resemble it, and how far its depth moves in them (method section 7)."""

from dataclasses import replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.method.effects.decide import Decision
from pagas_cl.method.splat import ViewInput, explained_by
from pagas_cl.method.splat.budget import fit_memory
from pagas_cl.method.splat.constants import MEAN, NUMBER
from pagas_cl.scene.choice import Partners

_COARSE = 64         # pixels of the longer side: at this size the depth is right, and what differs is the photos
_TILES = 6           # along each side of the target
_LEAST = 50          # samples from which a view is judged
_NOISE = 0.02        # share of a patch that no photo explains
_PATCH = 8.0         # 1 / variance of the depth by one patch that is explained, 1 / squared coarse pixels of parallax
_FEW = 2             # views that each tile is to have
_SEEN = 0.25         # share of a tile that a view must see to be one of them
_LITTLE = 1e-6       # that one of those adds at least


def views_to_ask(given: ViewInput, partners: Partners, config: Config) -> tuple[Partners, Decision | None]:
    """`partners` without the views that would take more than they add, and why; all, and None, where the effect is off,
    or fewer are usable than wanted. The context views of `given` are all of these, in their order."""
    usable, choice = (*partners.contexts, *partners.held_out), config.effects.resemblance
    if choice in ("off", "set") or len(usable) < config.context.number:
        return partners, None
    scale = min(1.0, _COARSE / max(given.target.camera.width, given.target.camera.height))
    parallax, explained = fit_memory(lambda given: explained_by(given, config, scale), given, config)
    judged = np.flatnonzero((parallax[:, NUMBER] >= _LEAST) & np.isfinite(explained).any(axis=(1, 2)))
    if not len(judged):
        return partners, None
    added = {usable[judged[k]] for k in adding(explained[judged], parallax[judged, MEAN])}
    unlike = {usable[k] for k in judged} - added
    contexts, held_out = (tuple(k for k in chosen if k not in unlike)
                          for chosen in (partners.contexts, partners.held_out))
    share = 1 - (len(contexts) + len(held_out)) / len(usable)
    return (replace(partners, contexts=contexts, held_out=held_out) if contexts else partners,
            Decision("resemblance", share, 0.0, share > 0, "share of usable views that resemble too little"
                     if choice == "auto" else f"requested: {choice}"))


def adding(explained: np.ndarray, parallax: np.ndarray) -> list[int]:
    """The views that add to what all say of the depth, one after the other, the one that adds most first. explained:
    (views, down, across), share of a patch that each photo explains, NaN = unknown; parallax: (views,), squared pixels
    by which a depth moves in each, in any unit."""
    known, share = np.isfinite(explained), np.nan_to_num(explained.astype(np.float64))
    weight = (parallax / np.median(parallax))[:, None]
    signal, noise = weight * _by_tile(share**2), weight * _by_tile(np.where(known, 1 + _NOISE - share, 0))
    area, seen = _by_tile(known.any(axis=0)[None])[0], _by_tile(known)

    def information(signal: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return np.log1p(_PATCH * signal**2 / np.maximum(noise, 1e-30) / np.maximum(area, 1))

    left, chosen, total = list(range(len(explained))), [], np.zeros((3, len(area)))
    while left:
        more = information(total[0] + signal[left], total[1] + noise[left]) - information(total[0], total[1])
        sees = seen[left] > _SEEN * area
        more = np.where((total[2] < _FEW) & sees, np.maximum(more, _LITTLE), more) @ area
        best = int(np.argmax(more))      # the first of equals
        if not more[best] > 0:
            break
        total += signal[left[best]], noise[left[best]], sees[best]
        chosen.append(left.pop(best))
    return chosen


def _by_tile(values: np.ndarray) -> np.ndarray:
    """Sums (views, tiles) of (views, down, across)."""
    rows, columns = (np.arange(size) * _TILES // size for size in values.shape[1:])
    tile = (np.arange(len(values))[:, None] * _TILES**2 + (rows[:, None] * _TILES + columns).ravel()).ravel()
    return np.bincount(tile, values.ravel().astype(np.float64), len(values) * _TILES**2).reshape(-1, _TILES**2)
