"""The method of the paper: splatting, effects, agreement, cameras, the surface (docs/method.md)."""
