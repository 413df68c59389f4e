"""Fit of the parameters of geometric sensor models to labelled frames.

>>> from ogm import open_dataset
>>> from ogm.calibration import calibrate
>>> calibrate(open_dataset("data/", split="train"), "ray").save("ray.json")                        # doctest: +SKIP
"""

from ogm.calibration.fit import calibrate

__all__ = ["calibrate"]
