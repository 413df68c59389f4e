"""How kernels are compiled.

numpy's error model spares divisions a branch that would keep loops off the vector units. Compiled code is
cached on disk.
"""

from numba import njit

__all__ = ["inline", "kernel", "vector"]

kernel = njit(cache=True, error_model="numpy")
inline = njit(cache=True, error_model="numpy", inline="always")
vector = njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "nnan"})  # for input without NaN
