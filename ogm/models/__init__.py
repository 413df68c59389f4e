"""Sensor models by name: geometric, learned, combined and fitted models of lidars and radars.

>>> from ogm import GridSpec, Mount
>>> from ogm.models import MODELS, load_model
>>> "combined" in MODELS
True
>>> load_model("ray", GridSpec.centered(), Mount(sensor_height=1.8)).spec.shape
(512, 352)
"""

from ogm.models.combined import CombinedISM, FreeGate, StateReliability
from ogm.models.fitted import Calibration
from ogm.models.layers import ExplainedISM, map_layers
from ogm.models.named import MODELS, default_model, describe_model, load_model

__all__ = [
    "MODELS", "Calibration", "CombinedISM", "ExplainedISM", "FreeGate", "StateReliability", "default_model",
    "describe_model", "load_model", "map_layers",
]  # fmt: skip
