"""Memory of long runs: return large arrays to the system."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc


def return_large_blocks(threshold: int = 8 * 2**20) -> bool:
    """Make the C library return freed blocks of at least `threshold` bytes to the system, and keep smaller ones.

    For processes that run for hours. By default glibc raises this threshold, up to 32 MB, when large arrays are freed:
    arrays of successive scans then fragment the heap, and the process grows by about 100 MB per hour. A block that is
    returned costs a page fault per 4096 bytes when it is needed again, about 1 us each: with a threshold of 512 KiB
    they took a fifth of the time of `ogm serve`. Equivalent to the environment variables ``MALLOC_MMAP_THRESHOLD_`` and
    ``MALLOC_TRIM_THRESHOLD_`` (32 times as large).

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
    if setting is None or setting(_M_MMAP_THRESHOLD, threshold) != 1:
        return False
    return bool(setting(_M_TRIM_THRESHOLD, 32 * threshold) == 1)
