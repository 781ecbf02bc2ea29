"""Float64 NumPy twins that only tests ask, in the conventions of pagas_cl.method.reference.

The twins of the photos' loss and its gradient ship with the package, since selftest and the trial of a device compare
with them. Here live the twins of the rest: smoothness, Adam's steps and the levels of the pyramid, exposure, evidence,
measurements.
"""
