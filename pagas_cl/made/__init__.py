"""Made scenes: analytic reliefs with exact depth and normals, and photos rendered in NumPy alone.

Flow: waves (height field) -> solid (relief, blocks, bar; exact intersection) -> texture -> photo -> scene.
"""

from pagas_cl.made.scene import MadeScene, Relief, relief_scene

__all__ = ["MadeScene", "Relief", "relief_scene"]
