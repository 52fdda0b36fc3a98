"""Dynamics of trees: quantities and kinematics, and four algorithms that check each other (EQUATIONS sections 2 to 5, 11).

`quantities` and `kinematics` hold the public functions; the algorithms are the recursions,
the matrix form in world axes and in link frames, and scans for many bodies (EQUATIONS sections 2 to 5, 11).

Imports `systems` and what is below it. The four algorithms do not import each other.
"""
