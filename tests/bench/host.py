"""What the host itself does for a view beside the device: processor time of the thread that launches, ms a view.

    python tests/bench/host.py                 # views of 200 x 150, `balanced`, twice
    python tests/bench/host.py --code FOLDER   # with the pagas_cl of another checkout, for comparison in turns

Launches cost what the driver's do (PoCL: some 10 us each); all else is Python's, and the same beside a GPU, which
waits for what is not `steps`: these are bound and launched while it works.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

VIEWS, TARGETS = 25, (6, 7, 8, 11, 12, 13, 16, 17, 18)
STAGES = (("resemblance", "views_to_ask"), ("effects", "measure"), ("splat.photos", "PhotoStore.level"),
          ("splat.level", "Level.__init__"), ("splat.level", "Level.run"), ("splat.evidence", "Evidence.decide"))


def watched() -> Counter:
    """Seconds of each stage without those inside it, from now on."""
    from importlib import import_module

    spent, inside = Counter(), [0.0]

    def watch(name, work):
        def watching(*given, **more):
            began = time.thread_time()
            inside.append(0.0)
            try:
                return work(*given, **more)
            finally:
                took = time.thread_time() - began
                spent[name] += took - inside.pop()
                inside[-1] += took
        return watching

    for module, path in STAGES:
        module = import_module(f"pagas_cl.{module}")
        *owner, name = path.split(".")
        holder = getattr(module, owner[0]) if owner else module
        work = getattr(holder, name)
        new = watch(path, work)
        setattr(holder, name, new)
        for other in [] if owner else [m for n, m in sys.modules.items() if n.startswith("pagas_cl")]:
            if getattr(other, name, None) is work:
                setattr(other, name, new)
    return spent


def scene():
    from dataclasses import replace

    from pagas_cl.app.synthetic import relief_scene
    from pagas_cl.app.synthetic.layout import camera_at
    from pagas_cl.scene.view import View

    made = relief_scene(200, 150, contexts=1, held_out=0)
    made = replace(made, cameras=[camera_at(made.relief, f"{k:03d}", 0.6 * (k % 5 - 2), 0.6 * (k // 5 - 2))
                                  for k in range(VIEWS)])
    return [View(camera, made.image(k)) for k, camera in enumerate(made.cameras)], [
        made.initial_depth(camera) for camera in made.cameras]


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("--code", type=Path, default=Path(__file__).parents[2])
    parse.add_argument("--times", type=int, default=2)
    ask = parse.parse_args()
    sys.path.insert(0, str(ask.code))
    import pagas_cl
    from pagas_cl import refine
    from pagas_cl.config.presets import BALANCED
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.choice import PartnerChooser

    print(f"{Path(pagas_cl.__file__).parent}")
    (views, depths), device = scene(), open_device(None)
    config = BALANCED.with_settings(effects__agreement="off", effects__cameras="set")
    photos, chooser = PhotoStore(device), PartnerChooser([view.camera for view in views], depths, config.context)
    partners, spent = {k: chooser.choose(k) for k in TARGETS}, watched()
    for number in range(ask.times + 1):         # the first one builds kernels
        spent.clear()
        began = time.thread_time()
        for k in TARGETS:
            refine.refine_one(views, partners[k], depths[k], config, device, photos, progress=lambda *_: None)
        spent["all"], steps = time.thread_time() - began, spent.pop("Level.run")
        spent["without steps"] = spent["all"] - steps
        if number:
            print(", ".join(f"{name} {1e3 * seconds / len(TARGETS):.2f}" for name, seconds in spent.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
