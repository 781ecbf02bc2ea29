"""How ssim.cl and loss.cl share an image between work-items: in vectors on a CPU, in tiles on a GPU."""

from dataclasses import dataclass, replace

from pagas_cl.method.splat.constants import HALO

BLOCK = (64, 4)           # target pixels of which it is known together in which rows they land (strip.clh)
STRIP_ROWS = 8            # least rows of a strip
STRIPS_A_CORE = 4         # more share the work better, and look through more blocks
BOX_GROUP = (32, 8)       # work-items that collect in local memory what falls into the same pixels (composite.cl)


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


def columns_of(device, width: int) -> int:
    """Pixels of a row of `width` that one work-item handles side by side: the lanes of the device, 1 on a GPU."""
    return device.lanes if device.lanes <= width else 1


def row_group(columns: int) -> tuple[int, int] | None:
    """Work-items of a group over an image: one where each holds a vector (PoCL's loop over several such items crashes
    at some image sizes), else the usual number."""
    return (1, 1) if columns > 1 else None


def strips(device, size) -> tuple[int, int]:
    """Work-items that share an image by its rows (strip.clh): some for each core, since not all rows take as long."""
    return max(1, min(size.height // STRIP_ROWS, STRIPS_A_CORE * device.info.compute_units)), 1


def blocks(size) -> tuple[int, int]:
    """Blocks of an image across and down."""
    return -(-size.width // BLOCK[0]), -(-size.height // BLOCK[1])


def choose_tiles(device, sizes) -> tuple[Tile, Tile]:
    """The tiles of ssim.cl and of loss.cl for images of `sizes`, (width, height) pairs, on `device`."""
    if device.lanes == 1:
        return SCALAR
    lanes = columns_of(device, min(width for width, _ in sizes))
    tile = Tile(64, 16, 1, lanes, lanes)
    if all(w >= tile.width + HALO and h >= tile.height + HALO for w, h in sizes):
        return tile, tile
    return tuple(replace(tile, group=1) for tile in SCALAR)       # vectors would cross the image's edge


def filter_tile(device, width: int) -> Tile:
    """The tile of gradient_filter.cl for a target of `width` on `device`."""
    lanes = columns_of(device, width)
    return Tile(64, 16, 1, lanes, lanes) if lanes > 1 else FILTERED


def pitch(width: int) -> int:
    """Floats in a row of the partials of an image of `width`."""
    return -(-width // 4) * 4
