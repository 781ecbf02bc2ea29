"""Options that several commands have, and the numbers that options take: what makes no sense is refused at once."""

import logging
import math

import typer

from pagas_cl.errors import log


def above_zero(text: str) -> float:
    return _number(text, lambda value: value > 0, "expected a number above 0")


def zero_or_more(text: str) -> float:
    return _number(text, lambda value: value >= 0, "expected a number that is 0 or more")


def _number(text: str, is_allowed, expected: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no number, {expected}") from error
    if not (math.isfinite(value) and is_allowed(value)):
        raise typer.BadParameter(f"{text}, {expected}")
    return value


def _warnings_only(quiet: bool) -> bool:
    if quiet and log.level == logging.INFO:      # not with --debug
        log.setLevel(logging.WARNING)
    return quiet


QUIET = typer.Option(False, "--quiet", callback=_warnings_only, is_eager=True, help="Only warnings and errors.")
DEPTH_DIR = typer.Option(None, "--depth-dir", help="Initial depth maps, <image stem>.npz, not --mesh.")
DEVICE = typer.Option(None, "--device", help="Part of an OpenCL device's name; see 'pagas-cl devices'.")
DEVICES = typer.Option(None, "--devices", metavar="all|NAME,...", help="One process on each of these devices.")
SCHEDULER = typer.Option(None, "--scheduler", metavar="tcp://HOST:PORT", help="A running Dask cluster; one that you "
                         "trust, since it may run any program here.")
FORMAT = typer.Option(None, "--format", help="Format of SCENE, where looking at it is not enough.")
OUTSIDE = typer.Option(False, "--outside", help="Allow files outside SCENE (scenes that you trust).")
PHOTOS = typer.Option(None, "--photos", help="Folder of the photos, where SCENE has no images/, or a network's small "
                      "ones there.")
SCENE = typer.Argument(..., metavar="SCENE", help="Folder with images/ and cameras (sparse/0, ...).")
OVERWRITE = typer.Option(False, "--overwrite", help="Replace files that pagas-cl has not written; never what is read.")
DEPTH_SCALE = typer.Option(None, "--depth-scale", parser=above_zero, metavar="NUMBER",
                           help="Number for one scene unit in the depth files.")
