"""Named hard cases on a device against the float64 twins: `pagas-cl selftest`, and the trial of a device."""
