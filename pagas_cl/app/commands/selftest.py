"""`pagas-cl selftest`: the hard cases on this machine's own device, against the float64 twins."""

import logging
import sys

from pagas_cl.app.commands._options import DEVICE, QUIET
from pagas_cl.app.commands._process import opened_device
from pagas_cl.app.selftest.check import run_all
from pagas_cl.app.selftest.table import CASES
from pagas_cl.errors import PagasError


def command(device: str = DEVICE, quiet: bool = QUIET):
    """Run the hard cases: case, tolerance, worst figure, ok. Status 1 when one of them fails."""
    opened = opened_device(device)
    logging.getLogger("pagas_cl").setLevel(logging.WARNING)     # plans of views would part the table
    total = sum(len(case.blends) for case in CASES)
    sys.stdout.write(f"{opened.info}\n{'':>9}{'case':<48}{'blend':<12}{'tolerance':>10}{'worst':>11}\n")
    failed = 0
    for number, outcome in enumerate(run_all(opened), start=1):
        case, place = outcome.case, f"{number}/{total}"
        result = "ok" if outcome.ok else "FAILED: " + "; ".join(outcome.faults)
        sys.stdout.write(f"{place:<9}{case.name:<48}{outcome.blend:<12}{case.tolerance:>10.0e}{outcome.worst:>11.1e}  "
                         f"{result}\n")
        sys.stdout.flush()
        failed += not outcome.ok
    sys.stdout.write(f"{total} runs of {len(CASES)} cases, {failed} failed\n")
    if failed:
        raise PagasError(f"{failed} of {total} hard cases failed on {opened.info.title}: do not trust results from "
                         "this device; update its driver, or choose another (pagas-cl devices)")
