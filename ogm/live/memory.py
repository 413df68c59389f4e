"""Memory of long runs: large arrays go back to the system."""

import ctypes

_M_MMAP_THRESHOLD = -3  # malloc.h of glibc


def return_large_blocks(threshold: int = 512 * 1024) -> bool:
    """Have the C library return every block from a size on to the system when it is freed.

    For processes that run for hours. By default glibc learns from the first large arrays that are freed to keep larger
    and larger ones in its heap, up to 32 MB: scans and grids of every scan then leave gaps among each other, and the
    process grows by some 100 MB in an hour. The same as the environment variable ``MALLOC_MMAP_THRESHOLD_``.

    Parameters
    ----------
    threshold : int
        [byte], above 0.

    Returns
    -------
    bool
        Whether the C library took it; others than glibc have no such setting.
    """
    if threshold <= 0:
        raise ValueError(f"threshold must be above 0 bytes, got {threshold}")
    setting = getattr(ctypes.CDLL(None), "mallopt", None)
    return setting is not None and setting(_M_MMAP_THRESHOLD, threshold) == 1
