"""Cameras that are off: errors with the true cameras, with those given, and with refined ones.

    python tests/bench/cameras.py [--scenes relief bar closed] [--width 240] [--draws 6] [--json FILE]
    python tests/bench/cameras.py --closed closed.pkl       # the last scene without Open3D, where that file is

Cameras rotated and moved at random so that photos move by 0, 0.5, 1, 3, 6 pixels (root mean square, with the same
random numbers), initial depth maps of the smoothed surface. Mean depth error of the refined views, pixels of parallax,
raw and after taking out what no photo sees (shift, tilt, scale); degrees for normals; pixels that cameras are off by
after a similarity. Real scenes: peer.py.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.record import add_json, record
from support.camera_noise import after_similarity, noisy, rms_motion

TITLE = "Cameras that are off"
MEASURED = ("Cameras of synthetic scenes rotated and moved at random by so many pixels; mean depth error in pixels of "
            "parallax, raw and after shift, tilt and scale are taken out, each for the input, true cameras, cameras as "
            "given, refined cameras; means over the draws; the worst draw as a multiple of what true cameras give, and "
            "of the input's raw error.")
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


def made(name: str, width: int, height: int, contexts: int, config, device, levels=LEVELS,
         closed: Path | None = None, draws: int = 1) -> list[dict]:
    """A row a level of noise and draw of it."""
    from support.synthetic import relief_scene

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
    return rows


def summary(rows: list[dict]) -> list[dict]:
    """A row for each scene and level, of those that `made` gave."""
    found = []
    for scene, level in dict.fromkeys((row["scene"], row["noise"]) for row in rows):
        of_level = [row for row in rows if (row["scene"], row["noise"]) == (scene, level)]
        shown = {name: ", ".join(f"{np.mean([row[who][what] for row in of_level]):.3g}"
                                 for who in ("input", "true", "as_given", "refined"))
                 for what, name in (("raw", "raw"), ("detrended", "detrended"), ("normals", "normals, degrees"))}
        worst = [max(row["refined"][what] / row[who][what] for row in of_level)
                 for who, what in (("true", "detrended"), ("true", "normals"), ("input", "raw"))]
        off = [np.mean([row[when] for row in of_level]) for when in ("given", "after")]
        found.append({"scene": scene, "noise, px": level, "cameras off: given, refined": f"{off[0]:.3g}, {off[1]:.3f}",
                      **shown, "worst draw: detrended, normals; raw": "{:.3f}, {:.3f}; {:.3f}".format(*worst),
                      "accepted": f"{sum(row['accepted'] for row in of_level)} of {len(of_level)}"})
    return found


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("--scenes", nargs="*", default=list(SCENES))
    parse.add_argument("--width", type=int, default=388)
    parse.add_argument("--closed", type=Path, help="file that keeps the closed object, of one width: made with Open3D "
                       "where it is not there, else read without it")
    parse.add_argument("--contexts", type=int, default=6)
    parse.add_argument("--levels", type=float, nargs="*", default=LEVELS)
    parse.add_argument("--draws", type=int, default=1, help="of each level of noise")
    parse.add_argument("--preset", default="balanced")
    parse.add_argument("--set", nargs="*", default=[], metavar="STAGE.FIELD=VALUE")
    parse.add_argument("--device")
    add_json(parse)
    given = parse.parse_args()
    from pagas_cl.config.presets import build_config
    from pagas_cl.runtime.device import open_device

    config, device = build_config(given.preset, given.set), open_device(given.device)

    size = given.width, round(given.width * 290 / 388)
    rows = [row for name in given.scenes
            for row in made(name, *size, given.contexts, config, device, given.levels, given.closed, given.draws)]
    record(TITLE, MEASURED, device.info.title, summary(rows), given.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
