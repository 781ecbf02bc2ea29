"""Cameras that are off, refined with the surface: dense photometric bundle adjustment (method section 9)."""
