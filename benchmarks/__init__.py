"""Measurements behind the claims; run with `python -m benchmarks` or one by one."""
