"""Expected time per view (pagas_cl.app.tradeoffs.costs), and the time that refine_views takes with photos from files.

    python tests/bench/scenes.py SCENES --data DATA
    python tests/bench/prediction.py SCENES [--json FILE] [--names relief bar motorcycle] [--device gpu]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from front import depth_of
from record import add_json, record

from pagas_cl.app.tradeoffs.costs import Costs, preset_ladder
from pagas_cl.refine import refine_views
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.readers import read_scene

TITLE = "Expected and taken time"
MEASURED = ("Seconds per view that `--time-per-view` and `--time-budget` expect from a probe of some seconds, and "
            "those that `refine_views` took, photos read from files; scenes of scenes.py.")
SETTINGS = ("fast", "balanced", "accurate")


def rows_of(folder: Path, device, most: int, presets):
    """A row for each of `presets` of a scene written by scenes.py; seconds per view."""
    scene = read_scene(folder)
    depths = [depth_of(folder / "depth_initial", view) for view in scene.views]
    names = [view.name for view, depth in zip(scene.views, depths) if depth is not None][:most]
    costs = Costs(scene.views, depths, device, names)
    for name, config in preset_ladder():
        if name not in presets:
            continue
        expected, times = costs.seconds(config), []
        for _ in range(3):  # the least: what else the machine does only adds
            start = time.perf_counter()
            refine_views(scene.views, depths, names=names, config=config, device=device)
            times.append((time.perf_counter() - start) / len(names))
        yield {"scene": folder.name, "settings": name, "views": len(names), "expected s per view": expected,
               "taken": min(times), "ratio": expected / min(times)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--names", nargs="*", default=("relief", "bar", "motorcycle", "dtu"))
    parser.add_argument("--device")
    parser.add_argument("--views", type=int, default=10, help="at most so many of each scene")
    parser.add_argument("--presets", nargs="*", default=SETTINGS)
    add_json(parser)
    given = parser.parse_args()
    device = open_device(given.device)
    rows = [row for name in given.names for row in rows_of(given.scenes / name, device, given.views,
                                                                   given.presets)]
    record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
