"""Synthetic scenes: analytic reliefs with exact depth and normals, and photos rendered in NumPy alone.

Flow: waves (height field) -> solid (relief, blocks, bar; exact intersection) -> texture -> photo -> scene.
"""

from pagas_cl.app.synthetic.scene import Relief, SyntheticScene, relief_scene

__all__ = ["SyntheticScene", "Relief", "relief_scene"]
