"""Rigid-body dynamics in JAX: pure functions of one sample, to be batched, compiled and differentiated."""

__version__ = "0.1.0"
