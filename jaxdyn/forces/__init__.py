"""Forces that a `Scene` adds to a system: joint springs, drives and friction, and dissipation functions.

Imports `dynamics` and what is below it.
"""
