"""Is the standard deviation that a refinement gives right? Errors against it, on scenes with truth.

    python tests/bench/calibration.py OUT [--data DIR] [--width 300] [--device NAME]

For each scene the distribution of |error| / deviation over the refined pixels: of calibrated deviations 68% lie below 1
and 95% below 2. OUT gets calibration.png and calibration.md. DIR holds Middlebury's motorcycle, as in scenes.py.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pagas_cl.app.synthetic import relief_scene
from pagas_cl.method.view.one_view import refine_depth
from pagas_cl.runtime.device import open_device
from pagas_cl.scene.depthmap import load_depth
from pagas_cl.scene.readers import read_scene

MADE = {"made, clean": {}, "made, exposure jitter": dict(steps=0, exposure=0.3),
        "made, noise": dict(steps=0, contrast=0.25, noise=6.0), "made, occluder": dict(bar=8.0),
        "made, shiny": dict(steps=0, shine=0.5)}


def scenes(width: int, data: Path | None, seed: int = 0):
    """(name, target, contexts, initial depth, true depth) of each."""
    for name, settings in MADE.items():
        made = relief_scene(width, width * 3 // 4, 5, held_out=0, seed=seed, **settings)
        camera = made.cameras[0]
        yield name, made.views[0], made.views[1:], made.initial_depth(camera), made.true_depth(camera)
    if data is not None:
        from scenes import motorcycle

        with TemporaryDirectory() as folder:
            motorcycle(data, Path(folder), 0.5)
            target, *contexts = read_scene(Path(folder)).views
            yield "Middlebury motorcycle, real", target, contexts, *(
                load_depth(Path(folder) / kind / f"{target.stem}.npz") for kind in ("depth_initial", "depth_true"))


def ratios(result, truth):
    """|error| / deviation of the refined pixels with truth, and error and deviation in pixels of parallax."""
    ok = (result.status == 1) & (truth > 0) & np.isfinite(result.deviation) & (result.parallax > 0)
    error, deviation, parallax = (x[ok].astype(np.float64) for x in (
        np.abs(result.depth - truth), result.deviation, result.parallax))
    return error / deviation, error / parallax, deviation / parallax


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--width", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic scenes")
    parser.add_argument("--device")
    given = parser.parse_args()
    device, found = open_device(given.device), {}
    lines = ["| scene | pixels | error, px (median) | deviation, px (median) | 68% of error / deviation | 95% | "
             "rank correlation |",
             "|---|---|---|---|---|---|---|"]
    for name, target, contexts, depth, truth in scenes(given.width, given.data, given.seed):
        ratio, error, deviation = ratios(refine_depth(target, contexts, depth, device=device), truth)
        found[name] = ratio
        lines.append(f"| {name} | {len(ratio)} | {np.median(error):.3f} | {np.median(deviation):.3f} | "
                     f"{np.quantile(ratio, 0.68):.2f} | {np.quantile(ratio, 0.95):.2f} | "
                     f"{rank(error, deviation):.2f} |")
        print(lines[-1], flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "calibration.md").write_text("\n".join([f"Measured on {device.info}.", "", *lines, ""]))
    draw(found, given.out / "calibration.png")


def rank(a, b) -> float:
    """Spearman's rank correlation: whether larger deviations stand where errors are larger."""
    return float(np.corrcoef(*(np.argsort(np.argsort(x)) for x in (a, b)))[0, 1])


def draw(found: dict, path: Path) -> None:
    """Share of pixels below each error / deviation, and what a normal distribution would give."""
    import matplotlib

    matplotlib.use("Agg")
    from math import erf

    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4))
    at = np.linspace(0, 4, 200)
    for name, ratio in found.items():
        axes.plot(at, np.searchsorted(np.sort(ratio), at) / len(ratio), label=name)
    axes.plot(at, [erf(x / 2**0.5) for x in at], "k--", label="normal distribution")
    axes.set(xlabel="|error| / deviation", ylabel="share of pixels below", ylim=(0, 1), xlim=(0, 4))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
