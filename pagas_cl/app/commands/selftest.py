"""`pagas-cl selftest`: the hard cases on this machine's own device, against the float64 twins."""

import logging
import sys
from itertools import chain

import typer

from pagas_cl.app.commands._options import DEVICE, QUIET
from pagas_cl.app.commands._process import opened_device
from pagas_cl.app.selftest import cameras
from pagas_cl.app.selftest.check import run_all
from pagas_cl.app.selftest.large import run_large
from pagas_cl.app.selftest.table import CASES
from pagas_cl.errors import PagasError


def command(
    device: str = DEVICE,
    large: bool = typer.Option(False, "--large", help="Also photos of 12 and 17 megapixels: a GPU with 8 GB or more."),
    quiet: bool = QUIET,
):
    """Run the small hard cases: case, tolerance, worst figure, ok. Status 1 when one of them fails."""
    opened = opened_device(device)
    logging.getLogger("pagas_cl").setLevel(logging.WARNING)     # plans of views would part the table
    total = sum(len(case.blends) for case in (*CASES, *cameras.CASES))
    sys.stdout.write(f"{opened.info}\n{'':>9}{'case':<48}{'blend':<12}{'tolerance':>10}{'worst':>11}\n")
    outcomes = []
    for number, outcome in enumerate(chain(
            run_all(opened), cameras.run_cameras(opened), run_large(opened) if large else ()), start=1):
        outcomes.append(outcome)
        case, place = outcome.case, f"{number}/{total}" if number <= total else "large"
        result = "ok" if outcome.ok else "FAILED: " + "; ".join(outcome.faults)
        sys.stdout.write(f"{place:<9}{case.name:<48}{outcome.blend:<12}{case.tolerance:>10.0e}{outcome.worst:>11.1e}  "
                         f"{result}\n")
        sys.stdout.flush()
    failed = [outcome for outcome in outcomes if not outcome.ok]
    sys.stdout.write(f"{len(outcomes)} runs of {len({o.case.name for o in outcomes})} cases, {len(failed)} failed\n")
    if failed:
        raise PagasError(f"{len(failed)} of {len(outcomes)} hard cases failed on {opened.info.title}: do not trust "
                         "results from this device; update its driver, or choose another (pagas-cl devices)")
