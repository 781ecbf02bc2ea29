"""Scenes whose photos do not match as they do in a renderer: errors of the depth maps of all views, refined one by one
and after the rounds of agreement, in one run.

    python tests/bench/agreement.py [--width 256] [--kinds gain blur ...] [--set STAGE.FIELD=VALUE ...] [--json FILE]

Six views of a relief whose initial depth is off by 0.6 pixels of parallax. Kinds of mismatch, each photo its own:
gain, a smooth field of 12 % (root mean square); blur, up to a pixel; haze, a veil of 10 to 30 % that is denser here
than there; jpeg, quality 60; shine, a highlight that moves; camera, turned by 0.35 pixels, half a pixel between two of
them; moving, something else in a disc, 8 % of the photo, at another place in each; together, all but that. Depth in
pixels of parallax, normals in degrees, both means; edges: within 3 pixels of one.
"""

import argparse
import io
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from PIL import Image
from record import add_json, record
from support.synthetic import relief_scene

from pagas_cl.app.evaluate.depth import compare_depth
from pagas_cl.config import Config
from pagas_cl.config.presets import BALANCED
from pagas_cl.method.splat import PhotoStore
from pagas_cl.method.surface.agree import counts
from pagas_cl.method.view.prediction import compare_predictions
from pagas_cl.method.view.rounds import later_rounds
from pagas_cl.refine import refine_views
from pagas_cl.result import RoundInput
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import PartnerChooser

TITLE = "Rounds of agreement: gain"
MEASURED = ("Six views of a synthetic relief whose photos do not match in some way, preset `balanced`: mean depth "
            "error (pixels of parallax), angle of normals, and both within 3 pixels of depth edges, of views refined "
            "one by one and after two rounds of agreement; share of rejected depths before and after; processor time "
            "of the rounds over that of the views.")
REAL_MEASURED = ("Real photos without truth: share of depths that two of the nearest four views confirm within half a "
                 "pixel of parallax, and correlation with the nearest photo left out.")
VIEWS = 6
OFF = 0.35      # pixels by which a camera is rotated


def field(rng, shape, waves: float) -> np.ndarray:
    """A smooth field over an image, root mean square 1."""
    v, u = (axis / size for axis, size in zip(np.mgrid[:shape[0], :shape[1]], shape))
    parts = [np.sin(2 * np.pi * (a * u + b * v) + c) for a, b, c in
             zip(rng.normal(size=4) * waves, rng.normal(size=4) * waves, rng.uniform(0, 2 * np.pi, 4))]
    return sum(parts)[..., None] / np.sqrt(2)


def gain(rng, photo):
    return photo * (1 + 0.12 * field(rng, photo.shape[:2], 3))


def blur(rng, photo):
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / max(rng.uniform(), 1e-3)) ** 2)
    for axis in (0, 1):
        padded = np.pad(photo, [(3, 3) if a == axis else (0, 0) for a in range(3)], mode="edge")
        photo = sum(weight * np.take(padded, np.arange(k, k + photo.shape[axis]), axis=axis)
                    for k, weight in enumerate(kernel / kernel.sum()))
    return photo


def haze(rng, photo):
    veil = rng.uniform(0.1, 0.3) * (1 + 0.5 * field(rng, photo.shape[:2], 1))
    return photo * (1 - veil) + 0.75 * veil


def jpeg(rng, photo):
    file = io.BytesIO()
    Image.fromarray(eight_bit(photo)).save(file, "jpeg", quality=60)
    return np.asarray(Image.open(file)) / 255


def moving(rng, photo):
    height, width = photo.shape[:2]
    v, u = np.mgrid[:height, :width]
    across = (v - height * rng.uniform(0.25, 0.75)) ** 2 + (u - width * rng.uniform(0.25, 0.75)) ** 2
    return np.where((across < (0.18 * height) ** 2)[..., None], np.roll(photo[::-1, ::-1], 11, axis=1), photo)


def turned(rng, camera: Camera) -> Camera:
    """The camera as somebody believes it to be whose image is off by OFF pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    x, y = OFF / camera.fx * np.array([np.cos(angle), np.sin(angle)])
    left, _, right = np.linalg.svd(np.array([[1, 0, x], [0, 1, y], [-x, -y, 1]]))
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    return Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                  pose @ camera.world_to_camera, camera.name)


KINDS = {"clean": (), "gain": (gain,), "blur": (blur,), "haze": (haze,), "jpeg": (jpeg,), "shine": (), "camera": (),
         "moving": (moving,), "together": (gain, blur, haze, jpeg)}


def eight_bit(photo) -> np.ndarray:
    return np.rint(np.clip(photo, 0, 1) * 255).astype(np.uint8)


def scene_of(kind: str, width: int, seed: int = 0):
    """Synthetic scene and its views with the mismatch."""
    made = relief_scene(width, width * 3 // 4, VIEWS - 1, held_out=0, seed=seed, detail=0.6,
                        shine=0.4 if kind in ("shine", "together") else 0.0)
    views = []
    for number, view in enumerate(made.all_views):
        rng = np.random.default_rng([seed, number, zlib.crc32(kind.encode())])
        photo = view.load_image() / 255
        for mismatch in KINDS[kind]:
            photo = mismatch(rng, photo)
        camera = turned(rng, view.camera) if kind in ("camera", "together") else view.camera
        views.append(replace(view, image=eight_bit(photo), camera=camera))
    return made, views


def errors(made, depths) -> np.ndarray:
    """Depth, normals, depth at edges, normals at edges: means over all views."""
    rows = []
    for camera, depth in zip(made.cameras, depths):
        found = compare_depth(depth, made.true_depth(camera), camera, parallax=made.relief.parallax,
                              true_normals=made.true_normals(camera))
        rows.append([found.smooth.mean_parallax, found.smooth.normal_mean, found.edges.mean_parallax,
                     found.edges.normal_mean])
    return np.mean(rows, axis=0)


def run(kind: str, width: int, config: Config, device) -> dict:
    """The row of a kind of mismatch."""
    made, views = scene_of(kind, width)
    depths = [made.initial_depth(camera) for camera in made.cameras]
    alone, agreed, (seconds, more_seconds) = both(views, depths, config, device)
    found = [errors(made, maps) for maps in (depths, depths_of(alone), depths_of(agreed))]
    shown = [f"{each[0]:.3f}, {each[1]:.1f}°, {each[2]:.3f}, {each[3]:.1f}°" for each in found]
    return {"mismatch": kind, **dict(zip(("input", "views by themselves", "after the rounds"), shown)),
            "ratio": ", ".join(f"{value:.3f}" for value in found[2] / found[1]),
            "rejected": f"{share_rejected(alone):.1%}, {share_rejected(agreed):.1%}",
            "time of the rounds": f"{more_seconds / seconds:.0%}"}


def both(views, depths, config: Config, device):
    """Results of views by themselves, and after the rounds; CPU seconds of both parts."""
    start = time.process_time()
    results = alone = refine_views(views, depths, config=config.with_settings(effects__agreement="off"), device=device)
    seconds = [time.process_time() - start]
    views = [replace(view, camera=result.camera) for view, result in zip(views, results)]    # cameras that were refined
    chooser = PartnerChooser([view.camera for view in views], depths, config.context)
    partners, photos = [chooser.choose(k) for k in range(len(views))], PhotoStore(device)
    start = time.process_time()
    for work in later_rounds(config, len(views)):
        before = dict(enumerate(results))
        inputs = [[RoundInput(before[k], before[k]) for k in partner.refined(before)] for partner in partners]
        results = [work(views, *both, config, device, photos) for both in zip(partners, inputs)]
    return alone, results, [*seconds, time.process_time() - start]


def depths_of(results) -> list[np.ndarray]:
    return [result.depth for result in results]


def real(scene: Path, mesh: Path, share: float, config: Config, device, most: int) -> dict:
    """What real photos without truth say: depths that context views confirm within half a pixel of parallax, of those
    that they should see; photos that took no part at all, predicted through the depth maps (correlation of patches,
    view by view: median, and in how many of the pairs it rose)."""
    from real import load

    views, depths = load(scene, mesh, None, share)
    views, depths = views[:most], depths[:most]
    used, kept_out = [k for k in range(len(views)) if k % 5 != 2], [k for k in range(len(views)) if k % 5 == 2]
    alone, agreed, seconds = both([views[k] for k in used], [depths[k] for k in used], config, device)
    maps = [[depths[k] for k in used], depths_of(alone), depths_of(agreed)]
    shares = [confirmed_share([views[k].camera for k in used], each, device) for each in maps]
    pairs = []
    for place, k in enumerate(used):
        nearest = min(kept_out, key=lambda j: np.linalg.norm(views[j].camera.center - views[k].camera.center))
        found = compare_predictions(views[k], [each[place] for each in maps], views[nearest], depths[nearest])
        pairs.append([prediction.median for prediction in found])
    pairs = np.array(pairs)
    shown = [f"{a:.1%}, {b:.4f}" for a, b in zip(shares, np.median(pairs, axis=0))]
    camera, gain = views[0].camera, pairs[:, 2] - pairs[:, 1]
    return {"scene": f"{scene.name}, {len(used)} views of {camera.width} x {camera.height}",
            **dict(zip(("input", "views by themselves", "after the rounds"), shown)),
            "views that predict as well or better": f"{(gain >= 0).sum()} of {len(pairs)}, least {gain.min():+.4f}",
            "rejected": f"{share_rejected(alone):.1%}, {share_rejected(agreed):.1%}",
            "time of the rounds": f"{seconds[1] / seconds[0]:.0%}"}


def confirmed_share(cameras, maps, device) -> float:
    """Of the depths that other views should see, those that two of them (one, where one alone sees it) confirm to half
    a pixel of parallax; the nearest four count."""
    seen, confirmed = 0, 0
    for k, (camera, depth) in enumerate(zip(cameras, maps)):
        near = sorted((j for j in range(len(cameras)) if j != k),
                      key=lambda j: np.linalg.norm(cameras[j].center - camera.center))[:4]
        by, expected = counts(camera, depth, [cameras[j] for j in near], [maps[j] for j in near], 0.5, device)
        seen += int((expected > 0).sum())
        confirmed += int(((expected > 0) & (by >= np.minimum(2, expected))).sum())
    return confirmed / seen


def share_rejected(results) -> float:
    counts = [result.counts for result in results]
    return sum(c["rejected"] for c in counts) / sum(c["rejected"] + c["refined"] for c in counts)


def main():
    from pagas_cl.config.presets import build_config

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, help="real photos, instead of made ones, with --mesh at --share of size")
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--share", type=float, default=0.125)
    parser.add_argument("--most", type=int, default=100, help="views of --scene")
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    parser.add_argument("--device", default=None)
    add_json(parser)
    given = parser.parse_args()
    device, config = open_device(given.device), build_config("balanced", given.settings) if given.settings else BALANCED
    if given.scene:
        rows = [real(given.scene, given.mesh, given.share, config, device, given.most)]
        record(f"{TITLE}, {given.scene.name}", REAL_MEASURED, device.info.title, rows, given.json)
    else:
        rows = [run(kind, given.width, config, device) for kind in given.kinds]
        record(TITLE, MEASURED, device.info.title, rows, given.json)


if __name__ == "__main__":
    main()
