"""Who is on the road: bodies, where they park, how they move."""

from ogm.simulation.traffic.bodies import Body, own_vehicle
from ogm.simulation.traffic.motion import Frame, Object, Traffic

__all__ = ["Body", "Frame", "Object", "Traffic", "own_vehicle"]
