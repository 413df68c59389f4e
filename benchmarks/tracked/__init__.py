"""The benchmarks that asv runs, see asv.conf.json."""
