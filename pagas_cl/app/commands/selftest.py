"""`pagas-cl selftest`: is this machine's device right? A recorded step, and a scene whose true depth is known."""

import logging
import sys

from pagas_cl.app.commands import _options as options
from pagas_cl.app.commands._process import opened_device
from pagas_cl.app.demo_scene import DemoScene, make_scene
from pagas_cl.app.device_check import TOLERANCE, outcomes, refinement_faults
from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.config.presets import preset
from pagas_cl.errors import PagasError
from pagas_cl.method.view.one_view import refine_depth

LEFT = 0.3      # most of the initial depth's error that a refinement may leave; 0.12 and 0.09 where all is well


def command(device: str = options.DEVICE, quiet: bool = options.QUIET):
    """Check the device: one step against float64, a small scene against its true depth, each twice.
    Status 1 when one of the checks fails."""
    opened = opened_device(device)
    logging.getLogger("pagas_cl").setLevel(logging.WARNING)     # plans of views would part the table
    sys.stdout.write(f"{opened.info}\n")
    faults = []
    for outcome in outcomes(opened):
        _show(f"gradient, {outcome.name}", f"differs by {outcome.worst:.1e} of {TOLERANCE:.0e}", outcome.faults)
        faults += outcome.faults
    scene = make_scene(160, 120, 4, opened)
    for name in ("fast", "balanced"):
        figures, found = _scene_faults(scene, preset(name), opened)
        _show(f"scene, preset {name}", figures, found)
        faults += found
    if faults:
        raise PagasError(f"{opened.info.title} fails {len(faults)} checks: do not trust results from this device; "
                         "update its driver, or choose another (pagas-cl devices)")


def _scene_faults(scene: DemoScene, config, device) -> tuple[str, list[str]]:
    """The error of a view before and after, in pixels of parallax, and what is wrong with two refinements of it."""
    target, *contexts = scene.views[:-1]
    initial, true = scene.initial[0], scene.true[0]
    results = [refine_depth(target, contexts, initial, config=config, device=device) for _ in range(2)]
    before, after = (compare_depth(depth, true, target.camera, parallax=scene.parallax).smooth.mean_parallax
                     for depth in (initial, results[0].depth))
    faults = refinement_faults(initial, results)
    if not after <= LEFT * before:
        faults.append(f"more than {LEFT:.0%} of the error is left")
    return f"error {before:.3f} -> {after:.3f} px of parallax", faults


def _show(check: str, figures: str, faults) -> None:
    sys.stdout.write(f"{check:<34}{figures:<40}{'ok' if not faults else 'FAILED: ' + '; '.join(faults)}\n")
    sys.stdout.flush()
