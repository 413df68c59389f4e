"""Fit of geometric sensor models to labelled frames, and a guarantee of false free for any model.

>>> from ogm import open_dataset
>>> from ogm.calibration import calibrate, guarantee
>>> calibrate(open_dataset("data/", split="train"), "ray").save("ray.json")                        # doctest: +SKIP
>>> guarantee(open_dataset("drives/"), "combined", limit=0.01).save("combined.json")               # doctest: +SKIP
"""

from ogm.calibration.drives import guarantee
from ogm.calibration.fit import calibrate

__all__ = ["calibrate", "guarantee"]
