"""Memory of long runs."""

import ctypes


def release_free_memory() -> bool:
    """Return the free pages of the C library's heap to the system; return whether there were any.

    For processes that run for hours: arrays of successive scans, of slightly different sizes, leave holes in the heap,
    and the process would grow by about 100 MB per hour. A call takes about 3 ms, and the next scan up to 20 ms longer.
    Only glibc has the function (``malloc_trim``); elsewhere nothing happens.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return trim is not None and trim(0) == 1
