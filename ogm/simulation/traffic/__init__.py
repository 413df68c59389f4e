"""Traffic participants: bodies, where they park, how they move."""

from ogm.simulation.traffic.bodies import Body, ego_body, ego_vehicle
from ogm.simulation.traffic.departure import Object
from ogm.simulation.traffic.motion import Traffic, TrafficState

__all__ = ["Body", "Object", "Traffic", "TrafficState", "ego_body", "ego_vehicle"]
