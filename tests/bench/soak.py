"""Many small views one after the other on one device: memory, open files and time per view must stay flat.

    python tests/bench/soak.py [VIEWS] [--json FILE]           # 200 by default; a row for each tenth of them
"""

from __future__ import annotations

import argparse
import gc
import logging
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from record import add_json, record

TITLE = "Many small views: nothing grows"
MEASURED = ("Views of 64 x 48 one after the other on one device: seconds of each tenth, memory of the process, open "
            "files, and memory held on the device after it.")


def resident_mb() -> float:
    """Memory of this process, MB; with a CPU device it holds the device's buffers too."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def soak(views: int = 200) -> list[tuple[float, float, int, float]]:
    """Seconds, resident MB, open files and MB held on the device after each tenth of the views."""
    from support import hard_scenes as make

    from pagas_cl.config.presets import BALANCED
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.method.view.one_view import refine_depth
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.view import View

    device = open_device()
    photos, config = PhotoStore(device), BALANCED.with_settings(pyramid__steps=(5,))
    photos.limit = 256 << 10
    base, found, start = make.base(1, (64, 48)), [], time.perf_counter()
    for number in range(1, views + 1):
        target = View(replace(base.target.camera, name=f"view {number}"), base.target.image)
        contexts = [View(v.camera, np.roll(v.image, number, axis=1)) for v in base.contexts]
        refine_depth(target, contexts, base.depth, config=config, device=device.info.name, photos=photos)
        if number % max(1, views // 10) == 0:
            gc.collect()
            found.append((time.perf_counter() - start, resident_mb(), len(os.listdir("/proc/self/fd")),
                          device.memory.held / 1e6))
            start = time.perf_counter()
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("views", type=int, nargs="?", default=200)
    add_json(parser)
    given = parser.parse_args()
    logging.getLogger("pagas_cl").setLevel(logging.ERROR)       # photos of noise: every view comes back unchanged
    found = soak(given.views)
    rows = [{"views": k * given.views // len(found), "s": seconds, "MB": resident, "open files": files,
             "MB on the device": held} for k, (seconds, resident, files, held) in enumerate(found, 1)]
    from pagas_cl.runtime.device import open_device

    record(TITLE, MEASURED, open_device(None).info.title, rows, given.json)
    warm = found[len(found) // 5:]                # compiling and caches belong to the first views
    grown, files = warm[-1][1] - warm[0][1], warm[-1][2] - warm[0][2]
    slower = np.median([w[0] for w in warm[-3:]]) / np.median([w[0] for w in warm[:3]])
    held = max(w[3] for w in warm) - min(w[3] for w in warm)
    ok = grown < 8 and files <= 0 and held < 0.1        # times are printed alone: other programs may use the machine
    print(f"{'flat' if ok else 'NOT FLAT'}: {grown:+.1f} MB, {files:+d} files, {held:+.3f} MB on the device, time per "
          f"view x {slower:.2f}")
    return 0 if ok else 1


if __name__ == "__main__":
    raise SystemExit(main())
