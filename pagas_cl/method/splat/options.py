"""What changes the shape of the code, as compile-time defines: an effect that is off is not in the program at all; how
work-items share an image, in vectors on a CPU, in tiles on a GPU; and the programs that are compiled with both."""

from dataclasses import dataclass, fields, replace
from math import ceil, floor, log2

import numpy as np

from pagas_cl.config import Config
from pagas_cl.method.splat.constants import HALO, SHARED, define
from pagas_cl.runtime.program import Launch, bind, build
from pagas_cl.scene.camera import Camera

BLOCK = (64, 4)           # target pixels of which it is known together in which rows they land (splat.clh)
STRIP_ROWS = 8            # least rows of a strip
STRIPS_A_CORE = 4         # more share the work better, and look through more blocks
BOX_GROUP = (32, 8)       # work-items that collect in local memory what falls into the same pixels (composite.cl)
SLOTS = 12                # candidates that a pixel sorts at a time (lists.clh)
LIST_GROUP = (32, 4)      # work-items that do so side by side: 12 bytes a slot at most, 18 kB of local memory


def reach(radius_threshold: float) -> int:
    """One-pixel bins that a Gaussian's mean may be away and still within `radius_threshold` of a pixel's centre."""
    return floor(radius_threshold + 0.5)


def span(radius_threshold: float) -> int:
    """Most pixel centres in a row within `radius_threshold` of a point, also where rounding to 32 bits adds to it."""
    return floor(2 * radius_threshold * (1 + 1e-6)) + 1


def heaviest_pixel(target: Camera) -> float:
    """More than the weights of all Gaussians of `target` can sum to in one pixel of any view, at any depths. Projected
    area is kept, so that one surface gives a pixel a weight of about pi / 2. Seen edge-on, a whole row of pixels may
    fall into one, each with the weight of its neighbours: sqrt(pi / 2) times the square root of how much longer a pixel
    is one way than the other. Twice that, and never more than all pixels together."""
    stretch = max(target.fx / target.fy, target.fy / target.fx) ** 0.5
    return min(3.2 * max(target.width, target.height) * stretch, 1.01 * target.width * target.height + 1)


def fixed_bits(weight: float) -> int:
    """Fractional bits of whole-number weights whose sum stays below `weight`: 32 bits hold it."""
    return max(1, min(20, 32 - ceil(log2(weight))))


def is_planar(config: Config) -> bool:
    return config.smoothness.kind == "planar" and config.smoothness.weight > 0


def defines(config: Config, device, weight: float) -> tuple[str, ...]:
    """The -D defines of every kernel for `config` on `device`; `weight` as heaviest_pixel has it."""
    splatting, loss = config.splatting, config.loss
    switches = {
        "ORDER_FREE": splatting.blend == "order_free",
        "NORMALIZE": splatting.blend == "alpha" and splatting.normalize,
        "OCCLUSION": splatting.occlusion,
        "DEPTH_RELATIVE": splatting.occlusion and splatting.depth_relative > 0,
        "LOW_PASS": splatting.low_pass > 0,
        "SSIM": loss.ssim > 0,
        "PLANAR": is_planar(config),
        "ROBUST": loss.robust > 0,
        **{own.metadata["define"]: getattr(loss, own.name) for own in fields(loss) if own.metadata["define"]},
        "TRACK_LOSS": config.solver.patience > 0,
        "INT64_ATOMICS": device.has("cl_khr_int64_base_atomics"),
    }
    numbers = {"REACH": reach(splatting.radius), "SPAN": span(splatting.radius), "SLOTS": SLOTS,
               "PLACE_BITS": max(1, ceil(log2((2 * reach(splatting.radius) + 1) ** 2))),
               "LIST_GROUP_W": LIST_GROUP[0], "LIST_GROUP_H": LIST_GROUP[1],
               "BOX_GROUP_W": BOX_GROUP[0], "BOX_GROUP_H": BOX_GROUP[1], "BLOCK_W": BLOCK[0], "BLOCK_H": BLOCK[1],
               "FIXED_ONE": float(1 << fixed_bits(weight))}
    if config.solver.gradient_filter > 0:
        numbers["FILTER_RADIUS"] = config.solver.gradient_filter
    return (*(name for name, on in switches.items() if on), *define(**numbers), *SHARED)


def numbers_of(config: Config) -> dict[str, float]:
    """Kernel arguments that are constants of `config`; inverses are rounded here: not all devices divide alike."""
    splatting, loss, one = config.splatting, config.loss, np.float32(1)
    radius_threshold = np.float32(splatting.radius)
    huber = np.float32(loss.huber)
    return {
        "low_pass": splatting.low_pass,
        "depth_relative": splatting.depth_relative,
        "radius_threshold": radius_threshold,
        "inverse_area": one / max(radius_threshold * radius_threshold, np.float32(1e-12)),
        "robust": loss.robust,
        "huber": huber,
        "inverse_huber": one / max(huber, np.float32(1e-37)),
    }


@dataclass(frozen=True)
class Tile:
    """Size of a tile in pixels, work-items that share it, and pixels that one of them handles side by side."""

    width: int
    height: int
    group: int          # work-items in a work-group
    columns: int        # pixels that a work-item handles side by side where all are handled alike
    lanes: int          # the same in a horizontal blur
    run: int = 4        # rows that it handles in a vertical blur; `height` is a multiple

    @property
    def defines(self) -> tuple[str, ...]:
        """The -D defines of lanes.clh and window.clh."""
        return (f"TILE_W={self.width}", f"TILE_H={self.height}", f"TILE_GROUP={self.group}", f"COLUMNS={self.columns}",
                f"LANES={self.lanes}", f"RUN={self.run}")

    def grid(self, width: int, height: int) -> tuple[int, int]:
        """Work-items that cover `width` x `height` pixels."""
        return -(-width // self.width) * self.group, -(-height // self.height)


# For ssim.cl and loss.cl: what fits into 32 kB of local memory, with few work-items that are idle in either pass; rows
# start on 16 bytes.
SCALAR = Tile(32, 12, 128, 1, 4, run=4), Tile(32, 16, 128, 1, 4, run=8)
FILTERED = Tile(32, 16, 256, 1, 4)        # for gradient_filter.cl


def strips(device, size) -> tuple[int, int]:
    """Work-items that share an image by its rows (splat.clh): some for each core, since not all rows take as long."""
    return max(1, min(size.height // STRIP_ROWS, STRIPS_A_CORE * device.info.compute_units)), 1


def blocks(size) -> tuple[int, int]:
    return -(-size.width // BLOCK[0]), -(-size.height // BLOCK[1])


def choose_tiles(device, sizes) -> tuple[Tile, Tile]:
    """The tiles of ssim.cl and of loss.cl for images of `sizes`, (width, height) pairs, on `device`."""
    if device.lanes == 1:
        return SCALAR
    lanes = device.columns(min(width for width, _ in sizes))
    tile = Tile(64, 16, 1, lanes, lanes)
    if all(w >= tile.width + HALO and h >= tile.height + HALO for w, h in sizes):
        return tile, tile
    return tuple(replace(tile, group=1) for tile in SCALAR)       # vectors would cross the image's edge


def filter_tile(device, width: int) -> Tile:
    """The tile of gradient_filter.cl for a target of `width` on `device`."""
    lanes = device.columns(width)
    return Tile(64, 16, 1, lanes, lanes) if lanes > 1 else FILTERED


def pitch(width: int) -> int:
    """Floats in a row of the partials of an image of `width`."""
    return -(-width // 4) * 4


class Programs:
    """The kernels as `config` wants them on `device`, for images of `cameras`, the target first: `defines` of every
    kernel file, `more` by file, and `tiles`, how work-items share an image, by file too."""

    def __init__(self, device, config: Config, cameras: list[Camera], more: dict | None = None):
        self.device, self.config = device, config
        self.defines = defines(config, device, heaviest_pixel(cameras[0]))
        self.tiles = dict(zip(("ssim.cl", "loss.cl"), choose_tiles(device, [(c.width, c.height) for c in cameras])))
        self.tiles["gradient_filter.cl"] = filter_tile(device, cameras[0].width)
        self.more = {**(more or {}), **{file: tile.defines for file, tile in self.tiles.items()}}
        self._columns = device.columns(cameras[0].width)
        self._settings, self._built = numbers_of(config), {}

    def bind(self, file: str, kernel: str, grid, buffers, view=None, group=None, /, **arguments) -> Launch:
        """A Launch of `kernel` of `file` over the work-items `grid`. An argument that is not given is the buffer of its
        name, of `buffers` (buffers.py), or what `view` (a LevelView) says of that name."""
        if file in self.tiles:
            grid, group = self.tiles[file].grid(*grid), (self.tiles[file].group, 1)
        return self._bind(file, self.more.get(file, ()), kernel, grid, group, buffers, view, arguments)

    def bind_rows(self, file: str, kernel: str, buffers, view, /, **arguments) -> Launch:
        """The same over the target's pixels: one each, or a row each where several pixels of it go side by side."""
        grid = view.target_size if self._columns == 1 else (1, view.target_size.height)
        return self._bind_columns(file, kernel, grid, buffers, view, arguments)

    def bind_row_ranges(self, buffers, view, /, **depth) -> list[Launch]:
        """What bind_scatter needs to know first: buffers.row_ranges."""
        if self._columns == 1 or buffers.row_ranges is None:
            return []
        return [self._bind_columns("project.cl", "find_row_ranges", blocks(view.target_size), buffers, view, depth)]

    def bind_scatter(self, file: str, kernel: str, buffers, view, /, **arguments) -> Launch:
        """A Launch of `kernel`, which adds where the target's Gaussians land: over its pixels, or the view's strips."""
        if self._columns == 1:
            return self._bind_columns(file, kernel, view.target_size, buffers, view,
                                      {"row_ranges": None, **arguments}, BOX_GROUP)
        return self._bind_columns(file, kernel, strips(self.device, view.size), buffers, view, arguments)

    def _bind_columns(self, file, kernel, grid, buffers, view, arguments, group=None) -> Launch:
        if self._columns > 1:
            group = (1, 1)        # each holds a vector: PoCL's loop over several such items crashes at some image sizes
        return self._bind(file, (f"COLUMNS={self._columns}",), kernel, grid, group, buffers, view, arguments)

    def _bind(self, file, more, kernel, grid, group, buffers, view, arguments) -> Launch:
        if (file, more) not in self._built:
            self._built[file, more] = build(self.device, file, (*self.defines, *more))
        known = {**self._settings, **vars(buffers), **(view.arguments if view else {})}
        return bind(self._built[file, more], kernel, grid, group, known, **arguments)
