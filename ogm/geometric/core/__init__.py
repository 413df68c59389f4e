"""Kernels: plain arrays and numbers in and out, one thread, nothing hidden.

They trust their input, which the friendly rooms above them check. Each has a slow twin in
`ogm.geometric.twins` that says the same in a few lines of Python.
"""
