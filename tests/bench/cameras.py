"""Cameras that are off: errors with the true cameras, with those given, and with refined ones.

    python tests/bench/cameras.py OUT                                    # made scenes: relief, bar, closed
    python tests/bench/cameras.py OUT --closed closed.pkl                # the last without Open3D, where that file is
    python tests/bench/cameras.py OUT --real dtu_scan24 --mesh dtu_scan24/derived/mesh_coarse.ply --share 0.5

Made scenes: cameras turned and moved at random so that photos move by 0, 0.5, 1, 3, 6 pixels (root mean square, with
the same random numbers), initial depth maps of the smoothed surface. Mean depth error of the refined views, pixels of
parallax, raw and after taking out what no photo sees (shift, tilt, scale); degrees for normals; pixels that cameras are
off by after a similarity. Real scenes: every fourth view is held out from everything and judges by the correlation of
7x7 patches, its pose fitted to each surface first. OUT gets table.md and figures.json.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from support.camera_noise import after_similarity, noisy, rms_motion

LEVELS = (0.0, 0.5, 1.0, 3.0, 6.0)
JUDGED = 7          # views of a made scene whose depths are compared with the truth
SCENES = {"relief": {}, "bar": {"bar": 8.0, "seed": 1}, "closed": None}


class Closed:
    """mesh_scenes.closed with what errors are measured against; one footprint is a unit, neighbours are 24 degrees
    apart. Photos and depth maps are drawn by Open3D, once: `Closed.kept` needs it no more."""

    def __init__(self, width: int):
        from mesh_scenes import closed

        from pagas_cl.method.surface.raster import each_depth
        from pagas_cl.scene.meshes.kinds import to_surface
        from pagas_cl.scene.view import View

        made = closed(width)
        self.cameras = made.cameras
        self._true, self._given = (dict(zip((c.name for c in made.cameras), each_depth(
            to_surface(mesh), made.cameras, None))) for mesh in (made.true, made.given))
        self.all_views = [View(camera, photo, name=camera.name) for camera, photo in zip(made.cameras, made.photos)]
        self.distance, self.parallax = float(np.linalg.norm(made.cameras[0].center)), 1 / np.tan(np.radians(24))

    @classmethod
    def kept(cls, width: int, file: Path | None) -> Closed:
        """The one that is in `file`; one made anew where there is no such file, which gets it."""
        if file is not None and file.exists():
            return pickle.loads(file.read_bytes())
        made = cls(width)
        if file is not None:
            file.write_bytes(pickle.dumps(made))
        return made

    def initial_depth(self, camera):
        return self._given[camera.name]

    def true_depth(self, camera):
        return self._true[camera.name]

    def true_normals(self, camera):
        from pagas_cl.result import normals_of

        return normals_of(self.true_depth(camera), camera)


def refined(views, depths, config, device, names):
    """Depth maps of the views `names`, refined as they are."""
    from pagas_cl.refine import refine_views

    config = config.with_settings(effects__cameras="off")
    return {result.name: result for result in refine_views(views, depths, names=names, config=config, device=device)}


def detrended(error, truth, valid) -> float:
    """Mean size of an error after the shift, tilt and scale that leave the least of it."""
    rows, columns = np.nonzero(valid)
    values = error[valid]
    basis = np.stack([np.ones(len(values)), rows / error.shape[0], columns / error.shape[1],
                      truth[valid] / np.median(truth[valid])], -1)
    left = values
    for _ in range(20):
        root = np.sqrt(1 / np.maximum(np.abs(left), 1e-3))
        left = values - basis @ np.linalg.lstsq(basis * root[:, None], values * root, rcond=None)[0]
    return float(np.abs(left).mean())


def errors(scene, parallax, cameras, results, depths=None) -> dict:
    """Means over the refined views."""
    from pagas_cl.method.view.prediction import box_sum
    from pagas_cl.result import normals_of

    rows = []
    for camera, name in ((c, c.name) for c in cameras if c.name in results):
        depth = results[name].depth if depths is None else depths[name]
        truth = scene.true_depth(camera)
        valid = np.zeros(truth.shape, bool)
        valid[10:-10, 10:-10] = box_sum(((truth > 0) & (depth > 0)).astype(float), 7)[10:-10, 10:-10] > 48.5
        error = (depth.astype(np.float64) - truth) / parallax
        cosine = (normals_of(depth, camera) * scene.true_normals(camera)).sum(-1)[valid]
        rows.append((np.abs(error[valid]).mean(), detrended(error, truth / parallax, valid),
                     np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()))
    return dict(zip(("raw", "detrended", "normals"), np.mean(rows, axis=0).tolist()))


def made(name: str, width: int, height: int, contexts: int, config, device, tell, levels=LEVELS,
         closed: Path | None = None, draws: int = 1) -> list[dict]:
    """A row a level of noise and draw of it."""
    from pagas_cl.app.synthetic import relief_scene
    from pagas_cl.method.cameras.refine import refine_cameras
    from pagas_cl.scene.view import View

    own = SCENES[name]
    scene = Closed.kept(width, closed) if own is None else relief_scene(width, height, contexts, held_out=0, **own)
    true, parallax = scene.cameras, scene.parallax if own is None else scene.relief.parallax
    depths = [scene.initial_depth(camera) for camera in true]
    names = [true[k].name for k in np.unique(np.linspace(0, len(true) - 1, JUDGED).astype(int))]
    photos = scene.all_views

    def through(cameras):
        return [View(camera, view.image, view.mask, view.name) for camera, view in zip(cameras, photos)]

    best = errors(scene, parallax, true, refined(through(true), depths, config, device, names))
    start = errors(scene, parallax, true, dict.fromkeys(names), {c.name: d for c, d in zip(true, depths)})
    rows = []
    for level, draw in [(noise, number) for noise in levels for number in range(draws if noise else 1)]:
        cameras = noisy(true, level, draw, getattr(scene, "distance", 650.0))
        clock = time.process_time()
        found = refine_cameras(through(cameras), depths, config=config, device=device)
        clock = time.process_time() - clock
        given = refined(through(cameras), depths, config, device, names)
        now = refined(through(found.cameras), depths, config, device, names)
        rows.append({"scene": name, "noise": level, "draw": draw, "off": found.report.get("off"),
                     "accepted": found.accepted, "reason": found.reason, "cpu": clock,
                     "largest_move": float(np.nanmax(found.moved)),
                     "given": rms_motion(true, after_similarity(cameras, true), depths),
                     "after": rms_motion(true, after_similarity(found.cameras, true), depths),
                     "input": start, "true": best, "as_given": errors(scene, parallax, true, given),
                     "refined": errors(scene, parallax, true, now),
                     "returned": sum(bool(r.reason) for r in given.values())})
        tell(rows[-1])
    return rows


def made_table(rows) -> str:
    """A row a level: means over the draws, and the draw that is worst against the true cameras."""
    lines = ["| scene | noise, px | cameras off: given, refined | depth, raw: input, true cameras, as given, refined |"
             " the same, detrended | normals | worst of the draws, times the true cameras': detrended, normals;"
             " times the input's: raw | |", "|" + "---|" * 8]
    for scene, level in dict.fromkeys((row["scene"], row["noise"]) for row in rows):
        of_level = [row for row in rows if (row["scene"], row["noise"]) == (scene, level)]
        parts = [", ".join(f"{np.mean([row[who][what] for row in of_level]):.3g}"
                           for who in ("input", "true", "as_given", "refined"))
                 for what in ("raw", "detrended", "normals")]
        worst = [max(row["refined"][what] / row[who][what] for row in of_level)
                 for who, what in (("true", "detrended"), ("true", "normals"), ("input", "raw"))]
        off = [np.mean([row[when] for row in of_level]) for when in ("given", "after")]
        stay = sum(not row["accepted"] for row in of_level)
        lines.append(f"| {scene} | {level:g} | {off[0]:.3g}, {off[1]:.3f} | " + " | ".join(parts)
                     + f" | {worst[0]:.3f}, {worst[1]:.3f}; {worst[2]:.3f} | "
                     + (f"{stay} of {len(of_level)} stay as given |" if stay else "|"))
    return "\n".join(lines)


def disagreement(cameras, *runs) -> list[tuple[float, float]]:
    """How far the refined depth maps of neighbours differ where a point was moved in all `runs` in both views: of each
    run's (cameras, initial depth maps, refined ones) the median, pixels (15 degrees between views), and the share
    within half a pixel."""
    told = [[] for _ in runs]
    axes = np.array([camera.direction for camera in cameras])
    for i in range(len(cameras)):
        changed = [np.logical_and.reduce([(maps[k] != given[k]) & (maps[k] > 0) for _, given, maps in runs])
                   for k in range(len(cameras))]
        rows, columns = np.random.default_rng(0).permutation(np.argwhere(changed[i]))[:4000].T
        for j in np.argsort(-axes @ axes[i], kind="stable")[1:4]:
            found = []
            for own, _, maps in runs:
                points = own[i].rays_at(rows, columns) * maps[i][rows, columns, None].astype(float)
                uv, z = own[j].project(points @ own[i].world_to_camera[:3, :3] + own[i].center)
                x, y = np.clip(np.floor(uv), 0, [own[j].width - 1, own[j].height - 1]).astype(int).T
                inside = (z > 0) & (uv > 0).all(axis=1) & (uv < [own[j].width, own[j].height]).all(axis=1)
                off = np.abs(maps[j][y, x] - z) / z * own[j].fx * np.tan(np.radians(15))
                found.append(np.where(inside & changed[j][y, x] & (off < 5), off, np.nan))
            both = np.isfinite(found).all(axis=0)
            for run, off in zip(told, found):
                run.append(off[both])
    return [(float(np.median(off)), float((off < 0.5).mean())) for off in map(np.concatenate, told)]


def draw_meshes(file: Path, config, *runs) -> None:
    """Normals of the mesh that each of `runs` (views, refined depth maps) makes, side by side, seen by a view in the
    middle."""
    from PIL import Image

    from pagas_cl.app.report.pictures import normal_colors
    from pagas_cl.method.surface.agree import confirmed
    from pagas_cl.method.surface.fuse import fuse
    from pagas_cl.method.surface.raster import each_depth
    from pagas_cl.result import normals_of

    pictures = []
    for views, depths in runs:
        cameras = [view.camera for view in views]
        mesh, camera = fuse(views, confirmed(cameras, depths, config.fusion), config.fusion), cameras[len(cameras) // 2]
        normals = normals_of(next(each_depth(mesh, [camera], None)), camera)
        pictures.append(np.asarray(normal_colors(normals, (normals**2).sum(axis=-1) > 0))[..., :3])
    Image.fromarray(np.concatenate(pictures, axis=1)).save(file, quality=88)


def real(scene: Path, mesh, depth_dir, share: float, number: int, judges: int, config, device, tell,
         out: Path) -> list[dict]:
    """A row for each of `number` views and its `judges` nearest held-out photos."""
    from real import nearest_held, with_cameras

    from pagas_cl.app.evaluate import compare_predictions
    from pagas_cl.method.cameras.judge import fitted_pose

    views, depths, held, (own, maps), found, (moved, drawn) = with_cameras(scene, mesh, depth_dir, share, config,
                                                                           device)
    tell({key: value for key, value in found.as_dict().items() if key != "rounds"})
    names = [own[k].name for k in np.unique(np.linspace(0, len(own) - 1, number).astype(int))]
    without, with_them = (refined(those, depths, config, device, names) for those, depths in
                          ((own, maps), (moved, drawn)))
    if len(names) == len(own):
        given = [view.camera for view in own]
        tell({"neighbours differ by, share within half a pixel": disagreement(
            given, *((cameras, initial, [results[view.name].depth for view in own]) for cameras, initial, results in
                     ((given, maps, without), (found.cameras, drawn, with_them))))})
        if find_spec("open3d") is None:
            tell("no picture of the meshes: Open3D is missing")
        else:
            draw_meshes(out / "meshes.jpg", config, *((those, [results[view.name].depth for view in own]) for those,
                                                      results in ((own, without), (moved, with_them))))
    rows = []
    for view, depth in zip(own, maps):
        if view.name not in names:
            continue
        for k in nearest_held(views, held, view, judges):
            candidates = [depth, without[view.name].depth, with_them[view.name].depth]
            fitted = [fitted_pose(views[k], view, one, depths[k], device) for one in candidates]
            told = compare_predictions(view, candidates, fitted, depths[k])
            if told[0].pixels > 1000:
                rows.append({"view": view.name, "held_out": views[k].name, "correlation": [p.median for p in told],
                             "reasons": [without[view.name].reason, with_them[view.name].reason]})
                tell(rows[-1])
    return rows


def real_table(rows) -> str:
    lines = ["| view | held-out photo | input | refined | cameras refined first |", "|" + "---|" * 5]
    lines += [f"| {row['view']} | {row['held_out']} | " + " | ".join(f"{c:.4f}" for c in row["correlation"]) + " |"
              for row in rows]
    means = np.mean([row["correlation"] for row in rows], axis=0)
    better = sum(row["correlation"][2] > row["correlation"][1] for row in rows)
    return "\n".join([*lines, "| mean | | " + " | ".join(f"{c:.4f}" for c in means) + " |", "",
                      f"{better} of {len(rows)} pairs better with cameras refined than without"])


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("out", type=Path)
    parse.add_argument("--real", type=Path)
    parse.add_argument("--mesh", type=Path)
    parse.add_argument("--depth-dir", type=Path)
    parse.add_argument("--share", type=float, default=1.0, help="of the photos' size")
    parse.add_argument("--views", type=int, default=4, help="real views that are refined")
    parse.add_argument("--judges", type=int, default=4, help="held-out photos of a real view, the nearest")
    parse.add_argument("--scenes", nargs="*", default=list(SCENES))
    parse.add_argument("--width", type=int, default=388)
    parse.add_argument("--closed", type=Path, help="file that keeps the closed object, of one width: made with Open3D "
                       "where it is not there, read without it elsewhere")
    parse.add_argument("--contexts", type=int, default=6)
    parse.add_argument("--levels", type=float, nargs="*", default=LEVELS)
    parse.add_argument("--draws", type=int, default=1, help="of each level of noise")
    parse.add_argument("--preset", default="balanced")
    parse.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parse.add_argument("--device")
    ask = parse.parse_args()
    from pagas_cl.config.assignments import build_config
    from pagas_cl.runtime.device import open_device

    config, device = build_config(ask.preset, ask.set), open_device(ask.device)

    def tell(row):
        sys.stderr.write(json.dumps(row) + "\n")

    ask.out.mkdir(parents=True, exist_ok=True)
    if ask.real:
        rows = real(ask.real, ask.mesh, ask.depth_dir, ask.share, ask.views, ask.judges, config, device, tell,
                    ask.out)
        text = real_table(rows)
    else:
        rows = [row for name in ask.scenes for row in made(name, ask.width, round(ask.width * 290 / 388), ask.contexts,
                                                            config, device, tell, ask.levels, ask.closed,
                                                            ask.draws)]
        text = made_table(rows)
    (ask.out / "figures.json").write_text(json.dumps(rows, indent=1))
    (ask.out / "table.md").write_text(text + "\n")
    sys.stdout.write(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
