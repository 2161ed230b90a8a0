"""Procedural hair for synthetic captures: grown on any rig's head, posed with it, drawn before its depth.

scalp.py says where hair grows, style.py what it is like, growth.py and face.py grow it, occlusion.py finds
its shadows, draw.py makes pictures of it.
"""

from cap4d.synth.hair.draw import HairLayer, HairLights, LitHair, composite_hair, draw_hair, light_hair
from cap4d.synth.hair.hair import Hair, grow_hair

__all__ = [
    "Hair",
    "HairLayer",
    "HairLights",
    "LitHair",
    "composite_hair",
    "draw_hair",
    "grow_hair",
    "light_hair",
]
