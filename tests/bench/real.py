"""Real photos: how well refined depth predicts photos that were kept out of the refinement, view by view.

    python tests/bench/real.py dtu_scan24 --mesh dtu_scan24/derived/mesh_coarse.ply [--json FILE]
    python tests/bench/real.py sceaux_castle --depth-dir DEPTHS
    python tests/bench/real.py hololens_rgbd                     # K.txt, poses.txt, depth/*.png in millimetres

For each view two of the photos that it would use are held out. The others refine it as `pagas_cl.refine_views` does,
which never sees those two; then both depths carry each held-out photo over to the view, and 7x7 patches of it are
correlated with the view's own photo over the pixels that both depths predict (medians), the pose of the held-out
photo fitted to each of both first (its camera is off, too). Cameras as given; refined ones, and a peer: peer.py.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from judging import BEHIND, blocks_of, gain
from record import add_json, record
from scenes import smaller

MEASURED = ("For each view two photos are held out and both depth maps, input and refined, carry them over to the "
            "view; median correlation of 7 x 7 patches, cameras as given.")


@dataclass(frozen=True)
class Row:
    """One view: names of the held-out photos, (before, after) for each and for both together, the gain with its
    standard deviation, and how it was refined."""

    view: str
    contexts: int
    held: tuple[str, ...]
    pairs: tuple[tuple[float, float], ...]
    pooled: tuple[float, float]
    gained: tuple[float, float]
    refined: float
    seconds: float
    reason: str

    @property
    def decision(self) -> str:
        """Equal: within two errors."""
        return decision(self.gained[0] if abs(self.gained[0]) > 2 * self.gained[1] else 0.0)


def decision(gained: float) -> str:
    return "better" if gained > 0 else "worse" if gained < 0 else "equal"


def load(scene: Path, mesh, depth_dir, share: float):
    """Views and initial depth maps, photos in memory, at `share` of their size."""
    if (scene / "poses.txt").exists():
        views, depths = _posed_frames(scene)
    else:
        from pagas_cl.scene.depthmap import find_depth, load_depth
        from pagas_cl.scene.readers import read_scene

        views, depths = read_scene(scene).views, None
        if depth_dir is not None:
            depths = [load_depth(find_depth(depth_dir, v.name), (v.camera.width, v.camera.height)) for v in views]
    views = [smaller(view, share) for view in views]
    if depths is None:
        from pagas_cl.refine import initial_depths
        from pagas_cl.scene.meshes.kinds import to_surface

        depths = initial_depths(to_surface(mesh), views)
    return views, [_fitting(depth, view.camera) for depth, view in zip(depths, views)]


def _posed_frames(scene: Path):
    """RGB-D frames with camera-to-world poses, one line a file, integer pixel centres, depth in millimetres."""
    from PIL import Image

    from pagas_cl.scene.camera import Camera
    from pagas_cl.scene.view import View

    matrix, poses = np.loadtxt(scene / "K.txt").reshape(3, 3), np.loadtxt(scene / "poses.txt").reshape(-1, 4, 4)
    views, depths = [], []
    for path, pose in zip(sorted((scene / "images").iterdir()), poses):
        width, height = Image.open(path).size
        camera = Camera.from_c2w(matrix, pose, width, height, pixel_center=0.0, name=path.name)
        views.append(View(camera, path, None, path.name))
        depths.append(np.asarray(Image.open(scene / "depth" / f"{path.stem}.png")).astype(np.float32) / 1000)
    return views, depths


def _fitting(depth, camera):
    from pagas_cl.scene.depthmap import resize_depth

    return resize_depth(depth, camera.width, camera.height)


def hold_out(target: int, cameras, depths, context):
    """Places of two photos that `target` would use, one of the best and the last; None where too few see it."""
    from pagas_cl.scene.choice import ContextChooser

    found = ContextChooser(cameras, depths, replace(context, number=context.number + 2)).choose(target).indices
    return (found[2], found[-1]) if len(found) > 3 else None


def refine_without(target: int, held, views, depths, config, device, photos):
    """The view refined as one of all views but those in `held`."""
    from pagas_cl.method.view.one_view import refine_one
    from pagas_cl.scene.choice import PartnerChooser

    left = [k for k in range(len(views)) if k not in held]
    chooser = PartnerChooser([views[k].camera for k in left], [depths[k] for k in left], config.context)
    return refine_one([views[k] for k in left], chooser.choose(left.index(target)), depths[target], config, device,
                      photos)


def judge(target: int, held, views, depths, result, fitted) -> Row:
    """Correlations of the held-out photos through the initial depth and the refined one; `fitted[k]`: the view k with
    its pose fitted to each of both."""
    from pagas_cl.method.view.prediction import compare_predictions

    both = [compare_predictions(views[target], [depths[target], result.depth], fitted[k], depths[k], tolerance=BEHIND)
            for k in held]
    seen = [np.isfinite(before.correlation) for before, _ in both]
    pooled = [np.concatenate([pair[which].correlation[where] for pair, where in zip(both, seen)]) for which in (0, 1)]
    first, second = map(blocks_of, seen)
    blocks = np.concatenate([first, second + first.max(initial=-1) + 1])
    gained = gain(1 - pooled[0], 1 - pooled[1], blocks) if len(blocks) else (0.0, 0.0)
    report, counts = result.report, result.counts
    surface = max(1, sum(counts.values()) - counts["no surface"])
    return Row(views[target].name, len(report.get("contexts", ())), tuple(views[k].name for k in held),
               tuple((before.median, after.median) for before, after in both),
               (float(np.median(pooled[0])), float(np.median(pooled[1]))), gained, counts["refined"] / surface,
               report.get("seconds", 0.0), result.reason)


def study(views, depths, config, device, names=(), keep=None) -> list[Row]:
    """A row a view; `keep(view, initial depth, result)` gets each result."""
    from pagas_cl.method.cameras.judge import fitted_pose
    from pagas_cl.method.splat import PhotoStore

    photos, rows = PhotoStore(device), []
    cameras = [view.camera for view in views]
    with ThreadPoolExecutor(os.cpu_count()) as judges:
        for target, view in enumerate(views):
            held = None if names and view.stem not in names else hold_out(target, cameras, depths, config.context)
            if held is None:
                continue
            result = refine_without(target, held, views, depths, config, device, photos)
            fitted = {k: [fitted_pose(views[k], view, depth, depths[k], device, photos)
                          for depth in (depths[target], result.depth)] for k in held}
            rows.append(judges.submit(judge, target, held, views, depths, result, fitted))
            if keep:
                keep(view, depths[target], result)
        return [row.result() for row in rows]


def shown(row: Row) -> dict:
    """The row of a view in the table."""
    cells = [f"{before:.4f}, {after:.4f}" for before, after in (*row.pairs, row.pooled)]
    return {"view": row.view, "context views": row.contexts,
            **dict(zip(("first: input, refined", "second", "both together"), cells)),
            "gain": f"{row.gained[0]:+.4f} ± {row.gained[1]:.4f}", "refined": f"{row.refined:.0%}",
            "prediction": row.decision, "s": row.seconds, "reason": row.reason or None}


def summary(rows: list[Row]) -> dict:
    """The last row of the table: counts of views and of pairs, mean gain of a pair."""
    pairs = [pair for row in rows for pair in row.pairs]
    gains = np.array([after - before for before, after in pairs])
    return {"view": f"all {len(rows)}", "prediction": _counts([row.decision for row in rows]),
            "first: input, refined": f"pairs: {_counts(map(decision, gains))}",
            "both together": f"mean gain of a pair {gains.mean():+.4f}, worst {gains.min():+.4f}",
            "s": np.median([row.seconds for row in rows])}


def _counts(decisions) -> str:
    found = list(decisions)
    return ", ".join(f"{found.count(word)} {word}" for word in ("better", "equal", "worse"))


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("scene", type=Path)
    parse.add_argument("--mesh", type=Path)
    parse.add_argument("--depth-dir", type=Path)
    parse.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parse.add_argument("--preset", default="balanced")
    parse.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parse.add_argument("--device")
    parse.add_argument("--views", nargs="*", default=[], help="stems; all by default")
    parse.add_argument("--save-depth", type=Path)
    add_json(parse)
    given = parse.parse_args()
    from pagas_cl.config.presets import build_config
    from pagas_cl.runtime.device import open_device
    from pagas_cl.scene.depthmap import save_depth

    config, device = build_config(given.preset, given.set), open_device(given.device)

    def keep(view, _, result):
        save_depth(given.save_depth / f"{view.stem}.npz", result.depth)

    rows = study(*load(given.scene, given.mesh, given.depth_dir, given.share), config, device, given.views,
                 keep if given.save_depth else None)
    record(f"Real photos, view by view: {given.scene.name}", MEASURED, device.info.title,
           [*map(shown, rows), summary(rows)], given.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
