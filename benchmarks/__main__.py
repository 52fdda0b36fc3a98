"""`python -m benchmarks` measures dynamics; the other scripts run by their names."""

from benchmarks import dynamics

dynamics.main()
