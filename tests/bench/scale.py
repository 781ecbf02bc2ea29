"""What a run of many views costs, from measured constants.

    python tests/bench/scale.py      # a table; with --json FILE for docs/benchmarks.md
"""

import argparse
from dataclasses import dataclass

from record import add_json, record

TITLE = "Many views, many devices: model"
MEASURED = ("A model, not a measurement, with the constants of scale.py: a worker is busy 0.01 s + 0.22 us a pixel "
            "with a view; GPUs, planning and storage overlap, the longest decides. For the measured run it gives 26.0 "
            "s and 13.0 s.")


@dataclass(frozen=True)
class Measured:
    """Measured as docs/benchmarks.md says (many views, planning, handing out); `disk` is assumed.

    Attributes
    ----------
    fixed, per_pixel : float
        Seconds that one GPU's worker is busy with a view: fixed + per_pixel * pixels.
    begin : float
        Seconds until a new worker has compiled its kernels.
    plan, take_back : float
        Seconds of the one planning process for a view: choosing its partners; handing it out and taking it back.
    photo_bytes : float
        Bytes of a photo's file, a pixel.
    photos_read : float
        Photos that a worker reads for each view of a long run.
    disk : float
        Bytes a second that the shared storage gives to all workers together.
    """

    fixed: float = 0.01
    per_pixel: float = 2.2e-7
    begin: float = 6.0
    plan: float = 4e-3
    take_back: float = 5e-3
    photo_bytes: float = 0.39
    photos_read: float = 3.4
    disk: float = 2e9


def run_seconds(views: int, pixels: float, gpus: int, m: Measured = Measured()) -> dict[str, float]:
    """Seconds that each part would take by itself; they overlap, so that the longest one decides."""
    size = min(16, max(1, views // (8 * gpus)))
    view = m.fixed + m.per_pixel * pixels
    rounds = -(-views // (size * gpus)) * size  # some do a batch more
    traffic = views * pixels * (4 + 4 + m.photos_read * m.photo_bytes)  # depth in and out, photos in
    return {"GPUs": m.begin + rounds * view, "planning": views * (m.plan + m.take_back), "storage": traffic / m.disk}


def rows() -> list[dict]:
    """A row for each size of run and number of GPUs."""
    found = []
    for views, pixels in ((160, 12e6), (10_000, 1.8e6), (10_000, 12e6)):
        alone = run_seconds(views, pixels, 1)["GPUs"]
        for gpus in (1, 8, 64):
            parts = run_seconds(views, pixels, gpus)
            slowest = max(parts, key=parts.get)
            found.append({"views": views, "pixels": f"{pixels / 1e6:g} M", "GPUs": gpus,
                          "GPUs' time": _time(parts["GPUs"]), "planning": _time(parts["planning"]),
                          "storage at 2 GB/s": _time(parts["storage"]), "decides": slowest,
                          "of ideal": f"{alone / gpus / parts[slowest]:.0%}"})
    return found


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_json(parser)
    record(TITLE, MEASURED, "none", rows(), parser.parse_args().json)


if __name__ == "__main__":
    main()
