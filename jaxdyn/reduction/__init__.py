"""Reduction: minimal velocities, the gauge-invariant form, and the integrability of constraints.

Imports `constraints` and the layers below. Source: EQUATIONS sections 6, 7 and 9.
"""
