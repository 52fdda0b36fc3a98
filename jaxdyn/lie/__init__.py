"""Rotations and rigid motions: SO(3), SE(2), SE(3), their exponentials, and series near zero (EQUATIONS sections 0 and 2).

Imports nothing of jaxdyn.
"""
