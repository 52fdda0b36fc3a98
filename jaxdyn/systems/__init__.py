"""Systems in motion: `Scene`, systems given by a Lagrangian or by M and h (EQUATIONS section 1), factors of mass matrices.

Imports `model` and what is below it.
"""
