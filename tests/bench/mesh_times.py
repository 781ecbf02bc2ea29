"""Seconds by stage and peak host memory from mesh and photos to mesh, on a made scene, without Open3D or SciPy.

    python tests/bench/mesh_times.py [--views 12] [--size 1554 1162] [--device gpu] [--output tsdf]
    python tests/bench/mesh_times.py --given     # the mesh stages alone, on the depth maps of a true mesh

The scene is made in processes of its own, so that it takes no memory here: a minute or two on 16 cores. Photos are
rendered at half size and enlarged: for times alone.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np


def make(folder: Path, views: int, size: tuple[int, int], spacing: float, photos: bool):
    """The scene's folder: photos, the initial and the true mesh. Gives its cameras."""
    from pagas_cl.app.synthetic import relief_scene
    from pagas_cl.app.synthetic.layout import camera_at

    made, side = relief_scene(size[0] // 2, size[1] // 2, contexts=1, held_out=0), int(np.ceil(np.sqrt(views)))
    made = replace(made, cameras=[camera_at(made.relief, f"{k:03d}", 0.6 * (k % side - (side - 1) / 2),
                                            0.6 * (k // side - (side - 1) / 2)) for k in range(views)])
    with multiprocessing.get_context("spawn").Pool() as pool:
        pool.apply(_make_meshes, (made, spacing, folder))
        pool.starmap(_make_photo, [(made, k, size, folder, photos) for k in range(views)], chunksize=1)
    return [camera.resized(*size) for camera in made.cameras]


def _make_photo(made, k: int, size: tuple[int, int], folder: Path, real: bool) -> None:
    from PIL import Image

    photo = made.image(k) if real else np.full((size[1] // 2, size[0] // 2, 3), 128, np.uint8)
    Image.fromarray(photo).resize(size, Image.BICUBIC).save(folder / f"{made.cameras[k].name}.png")


def _make_meshes(made, spacing: float, folder: Path) -> None:
    from pagas_cl.app.synthetic.layout import half_sizes
    from pagas_cl.app.synthetic.mesh import solid_mesh

    true = solid_mesh(made.true_solid, made.relief.footprint, half_sizes(made.relief))
    for name, (vertices, faces) in (("initial", made.initial_mesh(spacing)), ("true", true)):
        np.savez(folder / f"{name}.npz", vertices=vertices, faces=faces)


def load_mesh(path: Path):
    from pagas_cl.scene.mesh import Surface

    with np.load(path) as file:
        return Surface(file["vertices"], file["faces"])


def given_results(views, depths, deviation: float):
    from pagas_cl.result import DepthResult
    from pagas_cl.scene.depthmap import REFINED

    for view, depth in zip(views, depths):
        yield DepthResult(view.camera, depth, np.full(depth.shape, REFINED, np.uint8),
                          np.full(depth.shape, deviation, np.float32), np.full(depth.shape, 10 * deviation, np.float32),
                          "", {}, view.name)


class Watch:
    """Prints what each stage took, and the memory that this process has, and the most that it has had so far."""

    def __init__(self):
        self.start, self.last = (time.perf_counter(), time.process_time()), (time.perf_counter(), time.process_time())

    def tell(self, stage: str, since=None) -> None:
        from pagas_cl.runtime.host import resident_mb

        now, since = (time.perf_counter(), time.process_time()), since or self.last
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
        print(f"{stage:28} {now[0] - since[0]:8.2f} s, {now[1] - since[1]:8.2f} s of CPU; now {resident_mb():6.0f}, at "
              f"most so far {peak:6.0f} MB", flush=True)
        self.last = now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", type=int, nargs=2, default=(1554, 1162))
    parser.add_argument("--device")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--output", default="mesh", choices=("mesh", "tsdf", "displace"))
    parser.add_argument("--spacing", type=float, default=8.0, help="edges of the given mesh, pixels")
    parser.add_argument("--given", action="store_true")
    ask = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, watch = Path(temporary), Watch()
        cameras = make(folder, ask.views, tuple(ask.size), ask.spacing / 2, not ask.given)
        watch.tell("make the scene")
        run(cameras, folder, ask, watch)


def run(cameras, folder: Path, ask, watch: Watch) -> None:
    from pagas_cl import refine
    from pagas_cl.config.presets import settings_of
    from pagas_cl.errors import log
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.method.surface import keep_mesh
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.inputs import as_views

    log.setLevel("INFO")
    device, config = open_device(ask.device), settings_of(ask.preset, None)
    views = as_views(cameras, [folder / f"{camera.name}.png" for camera in cameras], None)
    surface = load_mesh(folder / "initial.npz")
    watch.tell(f"open {device.info.title}")
    start = watch.last
    if not ask.given:
        photos = PhotoStore(device)
        views, config, _ = refine.resolve_cameras(views, surface, config, device, None, photos)
    watch.tell("are cameras off?")
    depths = refine.initial_depths(surface, views, device=device)
    watch.tell("draw the given mesh")
    if ask.given:
        results = list(given_results(views, refine.initial_depths(load_mesh(folder / "true.npz"), views, device=device),
                                     0.1 * float(np.median(depths[0])) / cameras[0].fx))
    else:
        results = refine.refine_views(views, depths, config=config, device=device, photos=photos)
    watch.tell("refine the views")
    if ask.output != "tsdf":
        made = keep_mesh.kept_mesh(surface, views, results, config, ask.output, device=device)
    else:
        made = refine.fuse_results(views, results, config, device=device)
    watch.tell(f"make the mesh ({ask.output})")
    watch.tell("in all", start)
    print(f"{len(surface.faces)} -> {len(made.faces)} triangles", file=sys.stdout)


if __name__ == "__main__":
    main()
