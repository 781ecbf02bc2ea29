"""Seconds by stage and peak host memory from mesh and photos to mesh, on a made scene, without Open3D or SciPy.

    python tests/bench/mesh_times.py [--views 12] [--size 1554 1162] [--device gpu] [--output tsdf] [--json FILE]
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

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from record import add_json, record

TITLE = "Mesh to mesh: stages"
MEASURED = ("Seconds from photos and a mesh to the mesh by stage, a synthetic relief; peak memory in 1e6 bytes.")


def make(folder: Path, views: int, size: tuple[int, int], spacing: float, photos: bool):
    """The scene's folder: photos, the initial and the true mesh. Gives its cameras."""
    from support.synthetic import relief_scene
    from support.synthetic.layout import camera_at

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
    from support.synthetic.layout import half_sizes
    from support.synthetic.mesh import solid_mesh

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
    """Seconds of each stage, of the clock and of the processor, and the peak memory of this process so far."""

    def __init__(self):
        self.rows: list[dict] = []
        self.start = self.last = (time.perf_counter(), time.process_time())

    def stage(self, name: str, since=None) -> None:
        """End of a stage that began with the last one's end, or at `since`."""
        now, since = (time.perf_counter(), time.process_time()), since or self.last
        self.rows.append({"stage": name, "s": now[0] - since[0], "processor time, s": now[1] - since[1],
                          "peak, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6})
        self.last = now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", type=int, nargs=2, default=(1554, 1162))
    parser.add_argument("--device")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--output", default="mesh", choices=("mesh", "tsdf", "displace"))
    parser.add_argument("--spacing", type=float, default=8.0, help="edges of the given mesh, pixels")
    parser.add_argument("--given", action="store_true", help="the mesh stages alone")
    add_json(parser)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, watch = Path(temporary), Watch()
        cameras = make(folder, options.views, tuple(options.size), options.spacing / 2, not options.given)
        watch.stage("make the scene")
        device = run(cameras, folder, options, watch)
    record(TITLE, MEASURED, device, watch.rows, options.json)


def run(cameras, folder: Path, options, watch: Watch) -> str:
    """Mesh and photos to mesh; gives the device's name."""
    from pagas_cl import refine
    from pagas_cl.config.presets import settings_of
    from pagas_cl.jobs.fusing import fuse_results
    from pagas_cl.jobs.place import Place
    from pagas_cl.method.splat import PhotoStore
    from pagas_cl.method.surface import keep_mesh
    from pagas_cl.method.surface.mesh_options import MeshOptions
    from pagas_cl.progress import NONE
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.inputs import as_views

    device, config = open_device(options.device), settings_of(options.preset, None)
    views = as_views(cameras, [folder / f"{camera.name}.png" for camera in cameras], None)
    surface = load_mesh(folder / "initial.npz")
    watch.stage(f"open {device.info.title}")
    start = watch.last
    if not options.given:
        views, config, _ = refine.resolve_cameras(views, surface, config, device, NONE, PhotoStore(device))
    watch.stage("check cameras")
    depths = refine.initial_depths(surface, views, device=device)
    watch.stage("render the given mesh")
    if options.given:
        results = list(given_results(views, refine.initial_depths(load_mesh(folder / "true.npz"), views, device=device),
                                     0.1 * float(np.median(depths[0])) / cameras[0].fx))
    else:
        results = refine.refine_views(views, depths, config=config, device=device)
    watch.stage("refine the views")
    if options.output != "tsdf":
        made = keep_mesh.kept_mesh(surface, views, results, config, MeshOptions(options.output), device).mesh
    else:
        made = fuse_results(views, results, config, place=Place(device))
    watch.stage(f"make the mesh ({options.output})")
    watch.stage("in all", start)
    watch.rows[-1]["triangles"] = f"{len(surface.faces)} to {len(made.faces)}"
    return device.info.title


if __name__ == "__main__":
    main()
