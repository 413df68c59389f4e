"""Memory of long runs: return large arrays to the system."""

import ctypes

_M_MMAP_THRESHOLD = -3  # malloc.h of glibc


def return_large_blocks(threshold: int = 512 * 1024) -> bool:
    """Make the C library return freed blocks of at least `threshold` bytes to the system.

    For processes that run for hours. By default glibc raises this threshold, up to 32 MB, when large arrays are freed:
    arrays of successive scans then fragment the heap, and the process grows by about 100 MB per hour. Equivalent to the
    environment variable ``MALLOC_MMAP_THRESHOLD_``.

    Parameters
    ----------
    threshold : int
        Size [byte], above 0.

    Returns
    -------
    bool
        Whether the setting was accepted; only glibc has it.
    """
    if threshold <= 0:
        raise ValueError(f"threshold must be above 0 bytes, got {threshold}")
    setting = getattr(ctypes.CDLL(None), "mallopt", None)
    return setting is not None and setting(_M_MMAP_THRESHOLD, threshold) == 1
