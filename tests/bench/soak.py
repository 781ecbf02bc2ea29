"""Many small views one after the other on one device: memory, open files and time per view must stay flat.

    python tests/bench/soak.py [views]            # 200 by default; one line every tenth of them, then the result
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import time
from dataclasses import replace

import numpy as np


def resident_mb() -> float:
    """Memory of this process, MB; with a CPU device it holds the device's buffers too."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def soak(views: int = 200) -> list[tuple[float, float, int, float]]:
    """Seconds, resident MB, open files and MB held on the device after each tenth of the views."""
    from pagas_cl.app.selftest import scenes as make
    from pagas_cl.config.presets import BALANCED
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.method.view.one_view import refine_depth
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.view import View

    device = open_device()
    photos, config = PhotoStore(device, limit_bytes=256 << 10), BALANCED.with_settings(pyramid__steps=(5,))
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
    views = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    logging.getLogger("pagas_cl").setLevel(logging.ERROR)       # photos of noise: every view is kept as it came
    found = soak(views)
    for k, (seconds, resident, files, held) in enumerate(found, 1):
        print(f"{k * views // len(found):>6} views {seconds:8.2f} s {resident:9.1f} MB {files:5d} files "
              f"{held:9.3f} MB on the device")
    warm = found[len(found) // 5:]                # compiling and caches belong to the first views
    grown, files = warm[-1][1] - warm[0][1], warm[-1][2] - warm[0][2]
    slower = np.median([w[0] for w in warm[-3:]]) / np.median([w[0] for w in warm[:3]])
    held = max(w[3] for w in warm) - min(w[3] for w in warm)
    ok = grown < 8 and files <= 0 and slower < 1.5 and held < 0.1
    print(f"{'flat' if ok else 'NOT FLAT'}: {grown:+.1f} MB, {files:+d} files, {held:+.3f} MB on the device, time per "
          f"view x {slower:.2f}")
    return 0 if ok else 1


if __name__ == "__main__":
    raise SystemExit(main())
