"""Rays through triangles: the only room that knows Embree.

Two engines make the same points. `public` needs nothing but embreex's own interface. `fused` calls the Embree library
that embreex's wheel carries with its widest coherent packets and does everything else of a sweep in the same compiled
loop; it is several times faster and is taken if it passes a self-test on this machine.
"""

from sensors.raycast.base import Bodies, Engine, Hits, Returns, Shot, Solid
from sensors.raycast.choice import ENGINES, open_engine

__all__ = ["ENGINES", "Bodies", "Engine", "Hits", "Returns", "Shot", "Solid", "open_engine"]
