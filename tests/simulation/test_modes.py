"""The search for the mode of contact forces, against an enumeration of all modes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.simulation.hybrid import transitions
from jaxdyn.simulation.hybrid.modes import Gram, Mode, elements_of

CONTACTS, SIZE = 3, 9


def planar_contacts():
    """Elements of three contacts with one direction of slip each."""
    builder = jd.ModelBuilder("ball")
    builder.add_body("ball", None, "free", (1.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)))
    row = lambda q, t: jnp.eye(6)[0]  # noqa: E731
    contacts = [jd.contact.gap_contact(lambda q, t: q[2], row, 0.5, name=f"contact {i}") for i in range(CONTACTS)]
    return elements_of(jd.Scene(builder.build(), forces=contacts), Pieces((), ()))


def all_modes(G, free, mu, slides, tol=1e-9):
    """Modes (closed, stick) of contacts that satisfy Coulomb's law, and whether small changes of the forces balance there.

    `G`, `free`: rows in the order (normal, tangent) of each contact; `slides` (n,): sign of the slip, 0 for contacts at rest.
    """
    found = []
    choices = [("open", "stick", 1, -1) if not s else ("open", s) for s in slides]
    for kinds in itertools.product(*choices):
        columns, rows = [], []
        for i, kind in enumerate(kinds):
            n, t = 2 * i, 2 * i + 1
            unit = np.eye(len(free))
            if kind == "stick":
                columns, rows = [*columns, unit[n], unit[t]], [*rows, n, t]
            elif kind != "open":
                columns, rows = [*columns, unit[n] - mu[i] * kind * unit[t]], [*rows, n]
        p = np.zeros(len(free))
        if rows:
            C = np.array(columns).T
            p = C @ np.linalg.solve((G @ C)[rows], -free[rows])
        rate = G @ p + free
        valid = True
        for i, kind in enumerate(kinds):
            n, t = 2 * i, 2 * i + 1
            if kind == "open":
                valid &= rate[n] >= -tol
            elif kind == "stick":
                valid &= p[n] >= -tol and abs(p[t]) <= mu[i] * p[n] + tol
            else:
                valid &= p[n] >= -tol and (slides[i] != 0 or kind * rate[t] >= -tol)
        if valid:
            # A unit of each normal force of a sliding contact changes them all by 1 - K, through its friction, while the closed
            # contacts remain closed. Minors of K that are not positive are pivots that are not.
            slide = [i for i, kind in enumerate(kinds) if kind not in ("open", "stick")]
            act = [r for r in rows if r % 2 == 0 or kinds[r // 2] == "stick"]
            push = (
                np.stack([-mu[i] * kinds[i] * G[act, 2 * i + 1] for i in slide], 1)
                if slide
                else np.zeros((len(act), 0))
            )
            change = -np.linalg.solve(G[np.ix_(act, act)], push)[[act.index(2 * i) for i in slide]]
            K = np.eye(len(slide)) - change
            stable = all(np.linalg.det(K[:k, :k]) > 0 for k in range(1, len(slide) + 1))
            found.append((tuple(k != "open" for k in kinds), tuple(k == "stick" for k in kinds), stable))
    return found


@pytest.mark.slow
def test_modes_are_those_of_an_enumeration_and_none_is_missed():
    """Random contacts with much friction: a mode that is found is one of all, and where none is found there is none."""
    elements, rng, count = planar_contacts(), np.random.default_rng(0), 400
    Y = rng.normal(size=(count, SIZE, 2 * CONTACTS))
    # Normals and tangents of a contact that depend on each other, as for light links: modes exist twice, or not at all.
    Y[:, :, 1::2] += rng.uniform(-2, 2, (count, 1, CONTACTS)) * Y[:, :, ::2]
    free, mu = rng.normal(size=(count, 2 * CONTACTS)), rng.uniform(0.3, 1.5, (count, CONTACTS))
    slides = rng.integers(-1, 2, (count, CONTACTS)).astype(float)
    rows = np.array([k for one in elements.each for k in (one.normal, *one.tangent)])
    back = np.argsort(rows)

    def search(Y, free, mu, slides):
        zero, flags = jnp.zeros(CONTACTS), jnp.ones(CONTACTS, bool)
        problem = transitions.Problem(
            Gram.of(Y[:, back]), free[back], mu, mu, zero, flags, slides == 0, ~flags, ~flags, jnp.ones(()), zero + 1
        )
        slip = jnp.stack([jnp.where(slides == 0, 1.0, slides), zero], 1)
        mode = Mode(flags, slides == 0, ~flags, jnp.zeros(0, bool), zero, zero)
        choice = transitions.search_mode(elements, problem, mode, slip, ~flags, True)
        return choice.mode.closed, choice.mode.stick, ~choice.wrong

    closed, stick, settled = map(np.asarray, jax.jit(jax.vmap(search))(Y, free, mu, slides))
    several = missing = 0
    for i in range(count):
        modes = all_modes(Y[i].T @ Y[i], free[i], mu[i], slides[i])
        stable = [mode[:2] for mode in modes if mode[2]]
        several, missing = several + (len(modes) > 1), missing + (not stable)
        assert settled[i] == bool(stable), (i, modes)
        assert not settled[i] or (tuple(closed[i]), tuple(stick[i] & closed[i])) in stable, (i, modes)
    assert several > 10 and missing > 5
