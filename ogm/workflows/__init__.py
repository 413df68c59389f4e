"""Whole jobs: a drive fused to files, many drives."""
