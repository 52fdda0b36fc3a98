"""An arm of two links and motions with exact derivatives: what tests of fits share."""

import numpy as np

import jaxdyn as jd


def planar_arm(mass1=1.0, mass2=0.8, dtype=None):
    """Two links about parallel horizontal axes, in the vertical plane, solid in all directions."""
    builder = jd.ModelBuilder("arm", dtype=dtype)
    moments = np.array([0.1, 0.09, 0.02])
    builder.add_body("a", axis=(0, 1, 0), inertia=(mass1, (0.02, 0.01, -0.5), mass1 * moments))
    builder.add_body("b", "a", pose=(0, 0, -1), axis=(0, 1, 0), inertia=(mass2, (0.01, 0, -0.4), mass2 * moments))
    return builder.build()


def sines(nv, n=300, seed=3, duration=6.0):
    """t (n,), and q, v and a (n, nv) of sums of sines: an exciting motion without noise."""
    generator = np.random.default_rng(seed)
    t = np.linspace(0, duration, n)
    amplitude, phase = generator.uniform(0.3, 1.0, (4, nv)), generator.uniform(0, 2 * np.pi, (4, nv))
    w = np.arange(1, 5)[:, None] * 1.3
    angle = w * t[:, None, None] + phase
    q = np.sum(amplitude * np.sin(angle), 1)
    v = np.sum(amplitude * w * np.cos(angle), 1)
    return t, q, v, np.sum(-amplitude * w**2 * np.sin(angle), 1)
