"""Launches of hypotheses.cl: where photos match badly, depths along the ray that they agree on (method section 8.2)."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat.constants import SHARED, define
from pagas_cl.method.splat.inputs import LevelInput, LevelView, enqueue_each
from pagas_cl.method.splat.measure import ImageNoise
from pagas_cl.method.splat.units import NormalizedDepth
from pagas_cl.runtime.memory import constant, download, release, upload
from pagas_cl.runtime.program import Fill, bind, build, run_once
from pagas_cl.scene.camera import Size

# Constants of section 8.2, fitted on a made scene with blocks and a bar, whose mesh was clustered within 6 pixels.
#
# name and value      unit                 what it is; what a larger value does
MOST_VIEWS = 6        # context views      that score hypotheses, the first ones; slower, surer
_MISMATCHED = 0.5     # 1 - correlation    of a pixel's patch with the better half of the photos, above which it is
                      #                    searched; fewer pixels are
_CONTRAST = 0.01      # colour, 0 to 1       difference from its middle at which a pixel of a patch counts half; patches
                      #                    reach across depth discontinuities,
_NOISY = 2.5          # times              the noise of the photo where that is more
_QUANTISATION = 0.004 # colour, 0 to 1       least noise that is reckoned with; patches of less contrast show nothing
_REACH = 40           # pixels of parallax that the sweep goes, in steps of one, each way; slower, more false matches
_BEYOND = 1.0         # share              of the range of inverse depth that the sweep may leave it by
_ITERATIONS = 2       # times              that planes spread over both colours of the chessboard; slower
_STRIDE = 3           # pixels             between those that are measured and swept; faster, misses what is thinner
_MOST = 1 << 14       # pixels             searched at a time, and
_SHARE = 1 / 64       # of all pixels      if those are fewer; more memory
AROUND = 8            # planes             around that are extended to a pixel
_SHIFTS = 5           # planes             that are compared of each of two depths to start from, half a pixel each way
_UNDEFINED = 2.0      # cost               of what no two photos show: the largest there is
OWN_DEFINES = define(MOST_VIEWS=MOST_VIEWS, AROUND=AROUND, UNDEFINED=_UNDEFINED)


def is_enabled(config: Config, contexts: int) -> bool:
    """Whether so many context views may be searched by: one alone confirms nothing."""
    return config.effects.hypotheses in ("auto", "on") and contexts > 1


class Hypotheses:
    """The search over one view at full size, whose `initial` depth is on the device."""

    def __init__(self, device, given: LevelInput, views: list[LevelView], initial: NormalizedDepth):
        self._device, self._size = device, views[0].size
        self._views = views[1:1 + min(given.contexts, MOST_VIEWS)]
        self._lanes = device.columns(self._size.width)
        self._program = build(device, "hypotheses.cl", (*SHARED, *OWN_DEFINES, f"COLUMNS={self._lanes}"))
        noise, _ = ImageNoise(device, views[0].photo, self._size).read()
        self._range = initial.nearest, initial.farthest
        self._known = {"depth": initial.buffer, "cameras": constant(device, given.camera_table),
                       "views": len(self._views), "contrast": max(_CONTRAST, _NOISY * noise),
                       "noise": max(_QUANTISATION, noise)**2, "same": None, **self._size.extent}
        self._allocate("surface", 12 * self._size.pixels)
        self._run("find_planes", self._size)

    @staticmethod
    def nbytes(size: Size, views: int) -> int:
        """Bytes of the device that a search takes at most."""
        return 41 * size.pixels + (12 + 4 * min(views, MOST_VIEWS)) * _at_a_time(size)

    @cached_property
    def _wanted(self) -> np.ndarray:
        """Where photos match badly under the planes (H, W): around such pixels of a grid."""
        height, width = self._size.shape
        rows, columns = np.ogrid[0:height:_STRIDE, 0:width:_STRIDE]
        grid = rows * width + columns
        cost = self._cost(grid.ravel()).reshape(grid.shape)
        mismatched: np.ndarray = (cost > _MISMATCHED) & (cost < _UNDEFINED)
        return mismatched.repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)[:height, :width]

    def search(self, least: float = 0.0, enough: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (N,) of the pixels where depths were found, and these, float32 (N,), units. None where no more than a
        share `least` of the pixels match badly, or `enough` were found."""
        depth = download(self._device, self._known["depth"], (self._size.height, self._size.width))
        places = np.flatnonzero(self._wanted & (depth > 0))
        if len(places) <= least * depth.size:
            return places[:0], depth.ravel()[:0]
        limits, (places, colours, swept) = _limits(*self._range), _in_parts(places, self._size.width)
        self._cost(places)
        self._allocate("initial", 12 * self._size.pixels)
        cl.enqueue_copy(self._device.queue, self._known["initial"], self._known["surface"])
        for part in swept:
            self._try(part, 2 * _REACH, lambda chunk: self._run("sweep_planes", (chunk["count"],), **chunk, **limits))
        self._accept(places)
        accepted = download(self._device, self._known["accepted"], depth.size, np.uint8)
        if np.count_nonzero(accepted.view(bool)) * _STRIDE**2 <= enough * depth.size:
            return places[:0], depth.ravel()[:0]
        for part in _ITERATIONS * colours:
            self._try(part, AROUND, lambda chunk: self._run("spread_planes", (chunk["count"],), **chunk))
        self._accept(places)
        self._allocate("found", 4 * len(places))
        self._run("keep_supported", (len(places),), count=len(places))
        found = download(self._device, self._known["found"], len(places))
        return places[found > 0], found[found > 0]

    def costs_nearby(self, places: cl.Buffer, count: int) -> cl.Buffer:
        """Of the planes at `count` places, int32, whose buffer it keeps, moved by up to half a pixel of parallax to
        where it is least, of what is of the same surface there: float32, the caller's."""
        self._known["places"] = places
        self._allocate("same", 4 * count)
        self._least(count, _SHIFTS, lambda chunk: self._run("shift_planes", (chunk["count"],), **chunk))
        costs: cl.Buffer = self._known.pop("cost")
        return costs

    def _accept(self, places: np.ndarray) -> None:
        """Note whether what was found so far at each of `places` is clearly better than the initial plane."""
        self._fill("accepted", np.uint8(0), self._size.pixels)
        for chunk in self._chunks(range(len(places)), 2):
            for row, source in enumerate(("initial", "surface")):
                self._run("take_planes", (chunk["count"],), source=self._known[source], row=row, **chunk)
            self._score(chunk)
            self._run("accept_planes", (chunk["count"],), **chunk)

    def _cost(self, places: np.ndarray) -> np.ndarray:
        """Of the planes at `places`, which are searched from here on."""
        self._known["places"] = upload(self._device, places.astype(np.int32))
        self._least(len(places), 1, lambda chunk: self._run(
            "take_planes", (chunk["count"],), source=self._known["surface"], row=0, **chunk))
        return download(self._device, self._known["cost"], len(places))

    def _least(self, count: int, number: int, make: Callable[[dict[str, int]], object]) -> None:
        """Leave in "cost" the least at each of `count` places, searched from here on; `number`, `make` as of _try."""
        self._fill("cost", np.float32(_UNDEFINED), count)
        self._try(range(count), number, make)

    def _try(self, part: range, number: int, make: Callable[[dict[str, int]], object]) -> None:
        """Keep the best of `number` hypotheses that `make` puts into "planes", and of what is there, for a `part`."""
        for chunk in self._chunks(part, number):
            make(chunk)
            self._score(chunk)
            self._run("choose_planes", (chunk["count"],), **chunk)

    def _chunks(self, part: range, number: int) -> list[dict[str, int]]:
        count = max(1, min(_at_a_time(self._size) // number, len(part)))
        self._allocate("planes", 12 * number * count)
        self._allocate("costs", 4 * number * count * len(self._views))
        return [{"first": start, "count": min(count, part.stop - start), "number": number} for start in part[::count]]

    def _score(self, chunk: dict[str, int]) -> None:
        enqueue_each(self._device.queue, self._views, lambda view: [
            bind(self._program, "score_planes", (chunk["count"], -(-chunk["number"] // self._lanes)), None,
                 {**self._known, **chunk, **view.arguments})])

    def _run(self, kernel: str, grid: tuple[int, ...], **arguments) -> None:
        self._program.run(kernel, grid, None, {**self._known, **arguments})

    def _allocate(self, name: str, nbytes: int) -> None:
        release(self._known.pop(name, None))
        self._known[name] = self._device.buffer(nbytes, name)

    def _fill(self, name: str, value: np.generic, count: int) -> None:
        self._allocate(name, value.nbytes * count)
        run_once(self._device.queue, [Fill(self._known[name], value, value.nbytes * count)])

    def release(self) -> None:
        """Let go of all but the initial depth."""
        for name, held in self._known.items():
            if isinstance(held, cl.Buffer) and name not in ("depth", "cameras"):
                held.release()


def _at_a_time(size: Size) -> int:
    """How many hypotheses are scored at a time, of all places together."""
    return 2 * _REACH * max(1, min(_MOST, int(_SHARE * size.pixels)))


def _in_parts(places: np.ndarray, width: int) -> tuple[np.ndarray, tuple[range, range], tuple[range, range]]:
    """Pixels (N,) of rows of `width`, the white ones of a chessboard first, then the black ones, of either those first
    that are swept; where both colours are, and what is swept of each."""
    row = places // width
    column = places - row * width
    black, is_swept = (row + column) % 2 == 0, (row % _STRIDE == 0) & (column % _STRIDE == 0)
    parts = [places[one] for one in (~black & is_swept, ~black & ~is_swept, black & is_swept, black & ~is_swept)]
    first, white, last, count = np.cumsum([len(part) for part in parts]).tolist()
    return np.concatenate(parts), (range(white), range(white, count)), (range(first), range(white, last))


def _limits(nearest: np.float32, farthest: np.float32) -> dict[str, float]:
    """Between which inverse depths the sweep goes, where the initial depth is between these."""
    most, least = np.float32(1) / nearest, np.float32(1) / farthest
    beyond = _BEYOND * float(most - least)
    return {"nearest": float(most) + beyond, "farthest": max(0.0, float(least) - beyond)}
