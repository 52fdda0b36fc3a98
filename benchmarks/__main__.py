"""All benchmarks, one after another."""

from benchmarks import dynamics

dynamics.main()
