"""Every kernel under Oclgrind, on a small scene: invalid accesses and data races are errors.

    python tests/hard_cases/oclgrind.py          # runs itself under oclgrind, prints the kernels and the errors

Oclgrind's own --uninitialized is not used: it reports the unused fourth component of every float3, three-line kernels
included. What it looks for is found in test_safety.py instead, where buffers start with other bits.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

SETTINGS = {
    "order-free": {},
    "order-free, all switches": dict(splatting__low_pass=0.3, splatting__depth_relative=0.5, loss__exposure=True,
                                     loss__unseen_mask=True, loss__gradient_weight=True, loss__coverage_weight=True,
                                     loss__structure=True, loss__robust=0.6, loss__target_view=True),
    "order-free, grey, L1": dict(loss__grey=True, loss__ssim=0.0, splatting__radius=2.6),
    "order-free, lanes": {},
    "alpha": {},
    "alpha, wide": dict(splatting__radius=2.6, splatting__occlusion=False),
    "alpha, grey, normalised": dict(loss__grey=True, splatting__normalize=True, splatting__low_pass=0.0),
    "alpha, crowded": dict(splatting__radius=1.4),
}


def command() -> list[str] | None:
    """What runs this file under Oclgrind; None where it is not installed."""
    found = shutil.which("oclgrind")
    return found and [found, "--data-races", "--max-errors", "20", sys.executable,
                      os.path.abspath(__file__), "--inside"]


def inside() -> None:
    """Run every kernel once or more, a step of each setting, two levels of one a blend; print the kernels' names."""
    from dataclasses import replace

    import numpy as np
    from support import hard_scenes as make
    from support.hard_table import BLENDS

    from pagas_cl.method.splat import PhotoStore, ViewInput, composite, options, refine_levels, relit_views
    from pagas_cl.method.splat.units import Start, room_for
    from pagas_cl.method.surface import mesh_solve
    from pagas_cl.method.surface.agree import counts
    from pagas_cl.method.view.one_view import refine_depth
    from pagas_cl.runtime import claim, program
    from pagas_cl.runtime import device as devices
    from pagas_cl.runtime.device import open_device
    from pagas_cl.runtime.memory import upload
    from pagas_cl.runtime.trial import Trial

    devices.try_device = claim.try_device = lambda *_: Trial(lanes=1)     # it would take minutes here
    device, launched, enqueue = open_device("oclgrind"), set(), program.Launch.enqueue

    def noted(launch, queue):
        launched.add(launch.cl_kernel.function_name)
        return enqueue(launch, queue)

    program.Launch.enqueue = noted
    for module in (options, composite):      # Oclgrind adds up the local memory of all kernels of a program
        module.LIST_GROUP = (16, 4)
    mesh_solve.STEPS = 3                     # of thirty, each of them the same kernels
    for name, settings in SETTINGS.items():
        scene = make.crowded(16, 14) if "crowded" in name else make.base(size=(17, 12))
        # its kernels are the same programs for either blend
        smoothness = "normal" if "switches" in name else "none" if "alpha" in name else "planar"
        scales = (0.5, 1.0) if name in BLENDS else (1.0,)
        config = BLENDS[name.split(",")[0]].with_settings(**settings, smoothness__kind=smoothness,
                                                         smoothness__weight=0.1, pyramid__scales=scales,
                                                         pyramid__steps=(1,) * len(scales))
        held_out = [scene.contexts[1]] if name == "order-free" else []
        if name == "order-free":
            refine_depth(scene.target, scene.contexts[:1], scene.depth, device="oclgrind", held_out=held_out,
                         config=config.with_settings(effects__mismatch="on", effects__shading="off"))
            relit_views(ViewInput(scene.target, scene.contexts, scene.depth, device, PhotoStore(device)), config)
        else:
            on = replace(device, lanes=4) if "lanes" in name else device        # as on a CPU
            start = None if "grey, L1" not in name else Start(      # as rounds have it
                upload(device, np.float32(scene.depth)), lambda *found: found, 0,
                room_for(scene.depth.shape).result)
            refine_levels(ViewInput(scene.target, scene.contexts, scene.depth, on, PhotoStore(on)), config, start=start)
    scene = make.base(size=(17, 12))
    adjust_cameras(scene, device)
    solve_a_mesh(make.base(size=(18, 16)), device)
    agree(scene, device)
    search(scene, device)
    carry(scene, device)
    counts(scene.target.camera, scene.depth, [view.camera for view in scene.contexts], [scene.depth, scene.depth],
           device=device)
    sys.stdout.write(f"kernels: {' '.join(sorted(launched))}\n")


def adjust_cameras(scene, device) -> None:
    """Every kernel of the refinement of cameras."""
    from pagas_cl.method.cameras.adjust import Adjuster, Frame
    from pagas_cl.method.cameras.normalize import normalize_photo
    from pagas_cl.method.splat.photos import rgba
    from pagas_cl.runtime.memory import upload
    from pagas_cl.scene.camera import Size

    frames = []
    for view in (scene.target, *scene.contexts):
        size = Size(view.camera.width, view.camera.height)
        normal = device.buffer(4 * size.pixels)
        normalize_photo(device, upload(device, rgba(view.load_image(), None)), size, 0.7, normal)
        frames.append(Frame(view.camera, normal, upload(device, scene.depth)))
    for intrinsics in (False, True):
        adjuster = Adjuster(device, 1.0, intrinsics)
        adjuster.block(frames[0], frames[1:], 1e-3, 0.1, limit=0.01)
    adjuster.costs(frames[0], frames[1:], 0.1)
    adjuster.carry(frames[1], upload(device, scene.depth), frames[0])
    adjuster.rescale(frames[0], 1.01, 0.0)


def search(scene, device) -> None:
    """Every kernel of the search for depths along the ray, and of comparing two to start from."""
    import numpy as np

    from pagas_cl.config.presets import BALANCED
    from pagas_cl.method.splat import PhotoStore, ViewInput, hypotheses_for
    from pagas_cl.method.splat.starts import better_of, places
    from pagas_cl.runtime.memory import upload

    given = ViewInput(scene.target, scene.contexts, scene.depth, device, PhotoStore(device))
    with hypotheses_for(given, BALANCED) as found:
        found._wanted[:] = False
        found._wanted[4:7, 6:9] = True
        found.search(enough=-1.0)
        found.costs_nearby(*places(device, scene.target.camera.size))
    given.normalized().release()
    both = [upload(device, depth) for depth in (scene.depth, 1.01 * scene.depth)]
    costs = np.random.default_rng(0).random((2, *scene.depth[::2, ::2].shape)).astype(np.float32)
    better_of(device, scene.target.camera.size, both, [upload(device, cost) for cost in costs])


def carry(scene, device) -> None:
    """Every kernel of carrying over what a smaller size has found."""
    from types import SimpleNamespace

    import numpy as np

    from pagas_cl.method.view.coarse_to_fine import Movement, moved_along

    small = scene.depth[::2, ::2]
    found = SimpleNamespace(depth=1.01 * small, parallax=np.full_like(small, 0.05), deviation=np.zeros_like(small))
    moved_along(scene.depth, Movement(small, found, 0.5), device)


def agree(scene, device) -> None:
    """Every kernel of the rounds of agreement."""
    import numpy as np
    import pyopencl as cl

    from pagas_cl.config.presets import BALANCED
    from pagas_cl.method.splat import PhotoStore, ViewInput, resolve_edges
    from pagas_cl.method.surface.agreement import Agreement
    from pagas_cl.result import DepthResult
    from pagas_cl.scene.depthmap import REFINED

    parallax = np.full(scene.depth.shape, 0.05, np.float32)
    said = [DepthResult(view.camera, scene.depth, np.full(scene.depth.shape, REFINED, np.uint8), 0.1 * parallax,
                        parallax) for view in (scene.target, *scene.contexts)]
    compared = Agreement(said[0], said[1:], device)
    compared.spread()

    def support(candidates, number, supported):
        compared.count_support(candidates, number, supported)
        all_but_the_own = np.ones((number, *scene.depth.shape), np.int8)
        all_but_the_own[0] = 0
        cl.enqueue_copy(device.queue, supported, all_but_the_own)

    known = {**compared.average(0.1, 2.0), "parallax": compared.maps.parallax, "own_depth": compared.maps.depth}
    given = ViewInput(scene.target, scene.contexts, scene.depth, device, PhotoStore(device))
    resolve_edges(given, BALANCED, known, support)


def solve_a_mesh(scene, device) -> None:
    """Every kernel of drawing and solving a mesh, and of what is wrong with its triangles: that of the depth map, and a
    triangle larger than the picture."""
    import numpy as np

    from pagas_cl.method.surface import mesh_levels
    from pagas_cl.method.surface.mesh_collapse import collapse
    from pagas_cl.method.surface.mesh_evidence import Observed
    from pagas_cl.method.surface.mesh_mending import without_new
    from pagas_cl.method.surface.mesh_solve import OnDevice, solve_mesh
    from pagas_cl.scene.mesh import Surface, grid_faces

    camera, depth = scene.target.camera, scene.depth
    points = (camera.rays() * depth[..., None]) @ camera.world_to_camera[:3, :3] + camera.center
    points = points.reshape(-1, 3)
    height, width = depth.shape
    at = np.arange(height * width).reshape(height, width)
    corners = [at[:-1:3, :-1:3], at[:-1:3, 1::3], at[1::3, :-1:3]]
    faces = np.stack([corner.ravel() for corner in corners], 1)
    behind = points[[0, width - 1, -1]] + 3 * camera.world_to_camera[2, :3]
    surface = Surface(np.concatenate([points, behind]), np.concatenate([faces, np.array([[0, 1, 2]]) + at.size]))
    deviation = np.full(depth.shape, 1e-3, np.float32)
    views = [Observed(view.camera, depth, deviation) for view in (scene.target, *scene.contexts)]
    solve_mesh(surface, views, device, rounds=1)
    mesh_levels.off_middles(OnDevice(device, surface), surface.vertices, surface.faces[:, :2], views, 0.0, 2, 1.0)
    grid = grid_faces(width, height)
    unit = np.full(len(points), 0.01, np.float32)
    collapse(device, points.astype(np.float32), unit, grid, grid, unit > 1, triangles=len(grid) // 2)
    moved = points.copy()
    moved[len(points) // 2] += 3 * (points[0] - points[-1])
    without_new(device, Surface(points, grid), None, moved, np.zeros(len(points), np.int32))


def main() -> int:
    if "--inside" in sys.argv:
        inside()
        return 0
    run = command()
    if not run:
        sys.stderr.write("oclgrind is not installed (Debian and Ubuntu: apt-get install oclgrind)\n")
        return 2
    with tempfile.TemporaryDirectory() as cache:      # of compiled programs
        return subprocess.run(run, env={**os.environ, "PYOPENCL_NO_CACHE": "1", "XDG_CACHE_HOME": cache},
                              check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
