"""Trees of bodies: joint kinds as data, the ten numbers of a body, `Model` and how one is built, ready-made robots.

Imports `lie` and `compile`. Conventions: docs/conventions.md.
"""
