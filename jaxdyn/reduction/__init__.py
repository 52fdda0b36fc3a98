"""Fewer coordinates than velocities: minimal velocities, the gauge-invariant form, and whether constraints are integrable
(EQUATIONS sections 6, 7 and 9).

Imports `constraints` and what is below it.
"""
