"""Kernels of the geometric models: arrays and numbers in, arrays out, one thread.

They trust their input, which the models check. `ogm.geometric.reference` holds slow references in plain Python
that tests compare with.
"""
