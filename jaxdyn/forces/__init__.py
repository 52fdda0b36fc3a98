"""Generalised forces listed in a `Scene`: joint springs, drives and friction, and dissipation functions.

Imports `dynamics` and what is below it.
"""
