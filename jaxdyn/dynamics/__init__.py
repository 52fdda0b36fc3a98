"""Dynamics of trees. `quantities` has what users call, `kinematics` poses and Jacobians; the algorithms are the recursions,
the matrix form in world axes and in link frames, and scans for many bodies (EQUATIONS sections 2 to 5, 11).

Imports `systems` and what is below it. The four algorithms do not import each other.
"""
