"""Pictures of what a run did, and one page to look at (Pillow and NumPy alone)."""

from pagas_cl.report.writer import Report

__all__ = ["Report"]
