"""Methods for the impulses of a step with contacts: Newton's method, projected Gauss-Seidel, and the convex relaxation.

    python -m benchmarks.contact_laws [--count 512]

Boxes on four corners are thrown at the ground, whose impulses are not unique: the hardest problems of rigid contacts with
twelve numbers. Printed are, of each method, the share of problems solved to 1e-10 (of the largest velocity), and how far it is
from Coulomb's law: the residual of the complementarity problem, and the velocity with which sliding contacts open.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from jaxdyn.compile import kernel
from jaxdyn.contact import coulomb, jordan
from jaxdyn.simulation import contact_problem

GROUPS = ((4, 3),)


def problems(count: int):
    """W, q and scale of the problems."""
    builder, rng = jd.ModelBuilder("box"), np.random.default_rng(0)
    builder.add_body("box", None, "free", (1.0, (0.0, 0.0, 0.0), (0.1, 0.2, 0.15)))
    corners = [(a, b, -0.1) for a in (-0.3, 0.3) for b in (-0.2, 0.2)]
    contacts = [jd.contact.ground_contact("box", p, 0.5, name=f"{i}") for i, p in enumerate(corners)]
    scene = jd.Scene(builder.build(), forces=contacts)
    places, none = contact_problem.contacts_of(scene, None), jnp.zeros(())
    q = np.tile([0, 0, 0.1, 1, 0, 0, 0.0], (count, 1))
    q[:, 2] += np.where(np.arange(count) % 2 == 0, 0.0, rng.uniform(0, 0.02, count))

    def one(q, v):
        problem = contact_problem.pose(places, scene, q, v, jnp.zeros(0), jnp.zeros(6), none, jnp.asarray(0.01))
        return contact_problem.scaled(places, problem, contact_problem.friction_of(places, scene, q.dtype))[:3]

    return jax.jit(jax.vmap(one))(q, rng.normal(size=(count, 6)))


def sweep(W, q, x, correction):
    """One sweep of projected Gauss-Seidel, contact by contact; `correction`: 1 for Coulomb's law, 0 for the relaxation."""
    for k in range(0, len(q), 3):
        at = slice(k, k + 3)
        s = W[at] @ x + q[at]
        s = s.at[0].add(correction * jnp.sqrt(s[1] ** 2 + s[2] ** 2))
        length = 1 / jnp.max(jnp.sum(jnp.abs(W[at, at]), 1))
        x = x.at[at].set(jordan.projection((x[at] - length * s)[None])[0])
    return x


def report(name: str, W, q, x):
    """Print what a method leaves of Coulomb's law."""
    y = jnp.einsum("nij,nj->ni", W, x) + q
    residual = np.asarray(jax.vmap(lambda x, y: coulomb.residual_at(GROUPS, x, y, jnp.zeros(())))(x, y))
    opening = np.asarray(jnp.where(x[:, ::3] > 1e-6, y[:, ::3], 0)).max(1)
    parts = np.quantile(residual, (0.5, 0.9, 1.0))
    print(
        f"{name}: {np.mean(residual < 1e-10):.1%} to 1e-10, residual at 50, 90, 100 %: {parts}, opens with {opening.max():.2g}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=512)
    jax.config.update("jax_enable_x64", True)
    W, q, scale = problems(parser.parse_args().count)
    solve = jax.jit(
        jax.vmap(
            lambda W, q, s: kernel(coulomb.solve, static=2, derivative=False)(GROUPS, True, W, q, s, jnp.zeros(()))
        )
    )
    found = solve(W, q, scale)
    print(
        f"Newton: {np.mean(found.solved):.2%} solved, steps {np.mean(found.steps):.2f} in the mean, {np.max(found.steps)} at most"
    )
    report("Newton", W, q, found.x)
    sweeps = jax.jit(
        jax.vmap(
            lambda W, q, n, c: jax.lax.fori_loop(0, n, lambda _, x: sweep(W, q, x, c), jnp.zeros_like(q)),
            (0, 0, None, None),
        )
    )
    for count in (50, 500, 4000):
        report(f"Gauss-Seidel, {count} sweeps", W, q, sweeps(W, q, count, 1.0))
    report("relaxation, 4000 sweeps", W, q, sweeps(W, q, 4000, 0.0))


if __name__ == "__main__":
    main()
