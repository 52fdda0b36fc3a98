"""Length of the first adaptive step, and the step-size control that begins with it."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from jaxdyn.compile.known import stop_gradient


class Adaptive(diffrax.PIDController):
    """diffrax's step-size control, with a first step from the derivative in any unit of time.

    diffrax chooses one from the derivative for a bare `ODETerm` only; what its own `diffeqsolve` passes on is wrapped, and
    starts with 0.01 s. A first derivative that is NaN starts with the whole span: a step that is NaN would make every later one
    NaN, rejected and tried again until the last of `max_steps`. A finite one is halved and halved again until the least
    step ends the run.

    The least step, `dtmin` at the end of the run, is shorter at earlier times, which can be told apart better.
    """

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """End of the first step and state of the controller."""
        if dt0 is None and _is_ordinary(terms):
            dt0 = first_step(
                terms, t0, t1, y0, args, self._get_error_order(error_order), self.rtol, self.atol, self.norm
            )
        first, state = super().init(terms, t0, t1, y0, dt0, args, func, error_order)
        return jnp.where(jnp.isfinite(first), jnp.minimum(first, t1), t1), state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether the step is kept, and the next one."""
        eps, at_end = jnp.finfo(jnp.result_type(t1)).eps, jnp.asarray(self.dtmin)
        least = jnp.clip(16 * eps * jnp.abs(t0), eps * at_end, at_end)
        local = eqx.tree_at(lambda c: c.dtmin, self, least)
        return diffrax.PIDController.adapt_step_size(
            local, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )


def first_step(terms, t0, t1, y0, args, order, rtol, atol, norm):
    """First step, (), s, of a method of this order.

    With sizes measured in tolerances, d0 = |y0|, d1 = |f0| and d2 = |f(t0 + h0, y0 + h0 f0) - f0| / h0 at a trial step h0 =
    0.01 d0/d1. The motion is then taken for one of rate w = d2/d1 and amplitude A = d1^2/d2, whose error A (w h)^order is to
    be 0.01; and h is at most 100 h0 and the span. Where d0 or the change d1 (t1 - t0) is below 1e-5, h0 is 1e-6 of the
    span.

    Source: Hairer, Norsett & Wanner 1993, section II.4, with h^(order) max(d1, d2) = 0.01 replaced by a rule that is the
    same in any unit of time.
    """
    t0, t1, y0, args = stop_gradient((t0, t1, y0, args))
    span = t1 - t0
    scale = jax.tree.map(lambda y: atol + rtol * jnp.abs(y), y0)

    def size(y):
        return norm(jax.tree.map(lambda y, s: y / s, y, scale))

    def derivative(carry, _):
        # Evaluated twice by one program: at y0, where f = 0 and h = 0, and at the trial step.
        f, h = carry
        y = jax.tree.map(lambda y, f: y + h * f, y0, f)
        f = terms.vf_prod(t0 + h, y, args, terms.contr(jnp.zeros_like(t0), jnp.ones_like(t0)))
        d0, d1 = size(y0), size(f)
        small = (d0 < 1e-5) | (d1 * span < 1e-5)
        trial = jnp.where(small, 1e-6 * span, 0.01 * d0 / jnp.where(small, jnp.ones_like(d1), d1))
        return (f, jnp.minimum(trial, span).astype(span.dtype)), (f, trial)

    _, (f, trial) = jax.lax.scan(derivative, (jax.tree.map(jnp.zeros_like, y0), jnp.zeros_like(span)), length=2)
    h0 = jnp.minimum(trial[0], span)
    d1 = size(jax.tree.map(lambda f: f[0], f))
    d2 = size(jax.tree.map(lambda f: f[1] - f[0], f)) / h0
    # Rest that ends at a later moment, and a straight line: rates bounded by the trial step and the span.
    d1 = jnp.maximum(d1, d2 * h0)
    tiny = jnp.finfo(d1.dtype).tiny
    rate = jnp.maximum(d2 / jnp.maximum(d1, tiny), 1e-3 / span)
    amplitude = jnp.maximum(d1 / rate, tiny)
    step = (0.01 / amplitude) ** (1 / order) / rate
    return jax.lax.stop_gradient(jnp.minimum(jnp.minimum(100 * h0, step), span))


def _is_ordinary(terms) -> bool:
    """Whether the term, unwrapped, is an `ODETerm`, or a sum of such."""
    inner = getattr(terms, "term", terms)
    parts = inner.terms if isinstance(inner, diffrax.MultiTerm) else (inner,)
    return all(isinstance(getattr(part, "term", part), diffrax.ODETerm) for part in parts)
