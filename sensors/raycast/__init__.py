"""Ray casting through triangles, the only room that imports Embree.

Two engines make the same points. `public` needs nothing but embreex's own interface. `fused` calls the Embree library
inside embreex's wheel with its widest coherent packets and computes all else of a sweep in the same compiled loop; it
is several times faster and is used if it passes a self-test on this machine.
"""

from sensors.raycast.base import Bodies, Engine, Hits, Returns, Solid, SweepRequest
from sensors.raycast.choice import ENGINES, open_engine

__all__ = ["ENGINES", "Bodies", "Engine", "Hits", "Returns", "SweepRequest", "Solid", "open_engine"]
