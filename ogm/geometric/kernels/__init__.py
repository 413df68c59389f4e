"""Kernels of the geometric models: arrays and numbers in, arrays out, one thread.

They trust their input, which the models check. Tests compare them with slow references in plain Python
(`tests/geometric/geometric_reference`).
"""
