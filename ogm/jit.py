"""How kernels are compiled: the one place for numba's flags.

All kernels release the GIL and are cached on disk. numpy's error model spares divisions a branch that would
keep loops off the vector units.
"""

from numba import njit

__all__ = ["inline", "kernel", "vector"]

kernel = njit(cache=True, nogil=True, error_model="numpy")
inline = njit(cache=True, nogil=True, error_model="numpy", inline="always")
vector = njit(  # for loops whose input holds no NaN
    cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "nnan"}
)
