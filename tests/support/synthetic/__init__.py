"""Synthetic scenes of tests and benchmarks: analytic reliefs with exact depth and normals, photos made in NumPy alone.

Flow: waves (height field) -> solid (relief, blocks, bar; exact intersection) -> texture -> photo -> scene.
"""

from support.synthetic.scene import Relief, SyntheticScene, relief_scene

__all__ = ["SyntheticScene", "Relief", "relief_scene"]
