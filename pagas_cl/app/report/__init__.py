"""Pictures of what a run did, and one page to look at (Pillow and NumPy alone)."""

from pagas_cl.app.report.mesh_view import mesh_viewer, write_mesh_page
from pagas_cl.app.report.writer import Report, picture_files

__all__ = ["Report", "mesh_viewer", "picture_files", "write_mesh_page"]
