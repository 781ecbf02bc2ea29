"""Named hard cases on a device against the float64 twins: `pagas-cl selftest` and tests/hard_cases run them."""

from pagas_cl.app.selftest.check import device_gradient, difference, given_surface, normalized, run_case, twin_gradient
from pagas_cl.app.selftest.table import BLENDS, config_of

__all__ = ["BLENDS", "config_of", "device_gradient", "difference", "given_surface", "normalized", "run_case",
           "twin_gradient"]
