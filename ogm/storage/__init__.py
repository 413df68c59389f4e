"""Files and processes: atomic writing, archives, memory limits, locks, object stores, workers."""
