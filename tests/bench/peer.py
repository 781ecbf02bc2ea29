"""Real photos, next to a peer: how well photos that took no part are predicted through each surface, view by view.

    python tests/bench/peer.py DATA [--scenes sceaux_castle] [--presets fast balanced] [--json FILE]
    python tests/bench/peer.py DATA --share 0.25 --presets fast      # a quarter of the photos' size, for a CPU

Held-out photos (SCENES) are kept out of everything. Each is carried over to the two photos nearest to it through each
surface: the input, a peer's refined mesh where the data has one, the refined depth maps, the mesh made of them as it
comes and with the peer's number of triangles. All are judged on the pixels that all of them predict. Needs no Open3D.
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from judging import INPUT, PEER, Candidate, judged, nearest
from real import load
from record import add_json, record

from pagas_cl.config import Config
from pagas_cl.config.presets import build_config
from pagas_cl.jobs.place import Place
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.surface.keep_mesh import kept_mesh
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.refine import initial_depths, refine_scene
from pagas_cl.runtime.device import Device, open_device
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.view import View, joined

TITLE = "Real photos next to a peer"
MEASURED = ("Held-out photos carried over to the two photos nearest to each through each surface, on the pixels that "
            "all surfaces predict: mean over these pairs of the median 1 - correlation of 7 x 7 patches, and of the "
            "median error in grey levels after gain and offset are fitted; how many pairs are better, equal (within "
            "two errors), worse than through the input and through the peer's mesh, which was made with all photos; "
            "share of the photos with a depth; seconds and peak memory of a run in a warm process, photos in memory.")
VIEWS_MEASURED = ("For each view and held-out photo: median 1 - correlation ± standard deviation of its difference to "
                  "the input's (quartiles over the pixels), median error in grey levels; `judged`: share of the view's "
                  "pixels that all surfaces predict.")
WARM = 0.1              # of the photos' size at least, at which kernels are built before times are taken


@dataclass(frozen=True)
class Scene:
    """Files of a folder of the data; `held`: places of the views that are kept out of everything."""

    held: tuple[int, ...]
    mesh: str | None = None
    peer: str | None = None


SCENES = {
    "sceaux_castle": Scene((3, 7), "scene_mesh.ply", "scene_mesh_refine.ply"),      # refined by OpenMVS
    "dtu_scan24": Scene((4, 9), "derived/mesh_coarse.ply"),
    "hololens_rgbd": Scene(tuple(range(2, 60, 4))),
}


class Peak:
    """Context: seconds and the peak of this process' host memory meanwhile, MB; NaN where Linux does not report it."""

    def __enter__(self) -> Peak:
        self.host = float("nan")
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        self._start = time.perf_counter()
        return self

    def __exit__(self, *_) -> None:
        self.seconds = time.perf_counter() - self._start
        with suppress(OSError):
            status = Path("/proc/self/status").read_text().split()
            self.host = int(status[status.index("VmHWM:") + 1]) * 1024 / 1e6


def of_mesh(name: str, surface: Surface, views: list[View], device: Device, **costs) -> Candidate:
    """A mesh as the `views` see it."""
    depths = initial_depths(surface, views, device=device)
    return Candidate(name, {view.name: (view, depth) for view, depth in zip(views, depths)},
                     {"triangles": len(surface.faces), **costs})


def ours(preset: str, config: Config, views: list[View], depths, given: Surface | None, wanted: int | None,
         device: Device) -> list[Candidate]:
    """What a run makes of the views: depth maps, the mesh, the mesh with about `wanted` triangles."""
    with Peak() as peak:
        done = refine_scene(views, given, None if given else depths, config, making=MeshOptions(None),
                            place=Place(device))
    used = {done.views[place].name: (replace(done.views[place], camera=result.camera), result.depth)
            for place, result in joined(done.views, done.results)}
    costs = {"s": peak.seconds, "host MB": peak.host,
             "device MB": max(result.report.get("device_bytes", 0) for result in done.results) / 1e6,
             "unchanged": sum(bool(result.reason) for result in done.results)}
    found = [Candidate(f"{preset}: depth maps", used, costs)]
    if given is None:
        return found
    refined = [view for view, _ in used.values()]

    numbers = {"mesh": None} | ({"mesh, the peer's triangles": wanted} if wanted else {})
    for name, triangles in numbers.items():
        with Peak() as peak:
            making = MeshOptions("mesh", triangles=triangles)
            mesh = kept_mesh(given, done.views, done.results, config, making, device).mesh
        took = {**costs, "s": costs["s"] + peak.seconds, "host MB": max(costs["host MB"], peak.host)}
        found.append(of_mesh(f"{preset}: {name}", mesh, refined, device, **took))
    return found


def measure(folder: Path, scene: Scene, share: float, presets: list[str], settings: list[str], device: Device,
            pictures: Path | None):
    """Candidates of a scene; (view, held-out photo) -> figures of each candidate."""
    mesh = scene.mesh and folder / scene.mesh
    views, depths = load(folder, mesh, None, share)
    kept = [k for k in range(len(views)) if k not in scene.held]
    own, maps = _at(kept, views, depths)
    given = mesh and to_surface(mesh)
    candidates = [Candidate(INPUT, {view.name: (view, depth) for view, depth in zip(own, maps)},
                            {"triangles": given and len(given.faces)})]
    wanted = None
    if scene.peer is not None:
        peer = to_surface(folder / scene.peer)
        candidates.append(of_mesh(PEER, peer, own, device))
        wanted = len(peer.faces)
    small = load(folder, mesh, None, min(share, max(share / 4, WARM)))
    for preset in presets:
        config = build_config(preset, settings)
        ours(preset, config, *_at(kept, *small), given, None, device)
        candidates += ours(preset, config, own, maps, given, wanted, device)
    photos, found = PhotoStore(device), {}
    for k in scene.held:
        for view in nearest(views[k], own, depths[k]):
            found[view.name, views[k].name] = judged(views[k], depths[k], view.name, candidates, device, photos,
                                                     pictures)
    found = {pair: figures for pair, figures in found.items() if figures is not None}
    if not found:
        raise SystemExit(f"{folder.name}: no photo predicts enough pixels at {share:g} of its size: give more --share")
    return candidates, found


def _at(kept: list[int], *lists) -> list[list]:
    return [[one[k] for k in kept] for one in lists]


def summary(scene: str, candidate: Candidate, found: dict) -> dict:
    """The row of a candidate: its costs, and means over the views."""
    own = [figures[candidate.name] for figures in found.values()]

    def against(other: str) -> str | None:
        """In how many views it is better, equal, worse by more than two errors."""
        if other not in own[0]["gains"]:
            return None
        gains = [figures["gains"][other] for figures in own]
        signs = [int(np.sign(gain)) * (abs(gain) > 2 * error) for gain, error in gains]
        return ", ".join(str(signs.count(sign)) for sign in (1, 0, -1))

    def mean(name: str) -> float:
        return float(np.mean([figures[name] for figures in own]))

    return {"scene": scene, "surface": candidate.name, **candidate.costs, "covers": f"{mean('covers'):.1%}",
            "1 - correlation": float(np.mean([figures["cost"][1] for figures in own])), "grey levels": mean("grey"),
            "than the input": against(INPUT), "than the peer": against(PEER)}


def by_view(scene: str, pair: tuple[str, str], found: dict[str, dict]) -> dict:
    """The row of a view and the photo that it is predicted from."""
    row = {"scene": scene, "view": pair[0], "held-out photo": pair[1], "judged": f"{found[INPUT]['judged']:.1%}"}
    for name, figures in found.items():
        low, middle, high = figures["cost"]
        error = f" ± {figures['gains'][INPUT][1]:.4f}" if INPUT in figures["gains"] else ""
        row[name] = f"{middle:.4f}{error} ({low:.3f}, {high:.3f}), {figures['grey']:.2f}"
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parser.add_argument("--presets", nargs="*", default=["fast", "balanced", "accurate"])
    parser.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parser.add_argument("--device")
    parser.add_argument("--maps", type=Path, metavar="FOLDER", help="pictures of where each is better than the peer")
    add_json(parser)
    options = parser.parse_args()
    device, rows, views = open_device(options.device), [], []
    if options.maps is not None:
        options.maps.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        candidates, found = measure(options.data / name, SCENES[name], options.share, options.presets, options.set,
                                    device, options.maps)
        rows += [summary(name, candidate, found) for candidate in candidates]
        views += [by_view(name, pair, figures) for pair, figures in found.items()]
    names = ", ".join(options.scenes) + (f", at {options.share:g} of the size" if options.share != 1 else "")
    second = options.json and options.json.with_stem(options.json.stem + "_views")
    record(f"{TITLE}: {names}", MEASURED, device.info.title, rows, options.json)
    record(f"{TITLE}, view by view: {names}", VIEWS_MEASURED, device.info.title, views, second)


if __name__ == "__main__":
    main()
