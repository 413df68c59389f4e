"""Kernels: plain arrays and numbers in and out, one thread, nothing hidden.

They trust their input, which the friendly rooms above them check. What the models and `local_ground` make of
them is said once more, slowly, in `ogm.geometric.twins`; tests compare the two.
"""
