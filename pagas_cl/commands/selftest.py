"""`pagas-cl selftest`: the hard cases on this machine's own device, against the float64 twins."""

from __future__ import annotations

import logging
import sys
from itertools import count

import typer


def command(
    device: str = typer.Option(None, "--device", help="Part of the name of an OpenCL device."),
    large: bool = typer.Option(False, "--large", help="Also photos of 12 and 17 megapixels: a GPU with 8 GB or more."),
):
    """Run the small hard cases: case, tolerance, worst figure, ok. Status 1 when one of them fails."""
    from pagas_cl.errors import PagasError
    from pagas_cl.runtime.device import open_device
    from pagas_cl.selftest import run_all
    from pagas_cl.selftest.table import CASES

    opened = open_device(device)
    logging.getLogger("pagas_cl").setLevel(logging.WARNING)     # plans of views would part the table
    tell = _progress_of(sum(len(case.blends) for case in CASES))
    sys.stdout.write(f"{opened.info}\n{'':>9}{'case':<48}{'blend':<12}{'tolerance':>10}{'worst':>11}\n")
    outcomes = run_all(opened, tell)
    if large:
        from pagas_cl.selftest.large import run_large

        outcomes += run_large(opened, tell)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    sys.stdout.write(f"{len(outcomes)} runs of {len({o.case.name for o in outcomes})} cases, {len(failed)} failed\n")
    if failed:
        raise PagasError(f"{len(failed)} of {len(outcomes)} hard cases failed on {opened.info.title}: do not trust "
                         "results from this device; update its driver, or choose another (pagas-cl devices)")


def _progress_of(total: int):
    """What writes a line for each outcome: which of the `total` small ones it is; large ones come after them."""
    numbers = count(1)

    def tell(outcome) -> None:
        case, number = outcome.case, next(numbers)
        place = f"{number}/{total}" if number <= total else "large"
        result = "ok" if outcome.ok else "FAILED: " + "; ".join(outcome.faults)
        sys.stdout.write(f"{place:<9}{case.name:<48}{outcome.blend:<12}{case.tolerance:>10.0e}{outcome.worst:>11.1e}  "
                         f"{result}\n")
        sys.stdout.flush()

    return tell
