"""Simulation of scenes; the only room that integrates.

`run` is `jd.simulate`, `methods` are the differential equations of a scene, `solvers/` the methods of diffrax and of our own,
`hybrid/` motion with events, `variational` steps for long motions, `stiffness` the rates of a scene. Imports `reduction`,
`constraints` and what is below them.
"""
