"""Messages on functions that have no kernel: whose they are, and what to write instead."""

from jaxdyn.compile import mode

# By the first words of a reason (see `NotNumbers`).
_REMEDIES = {
    "sort": "take jnp.minimum, jnp.maximum or jnp.argmax, or sort outside of the function",
    "svd": "decompose a constant matrix once, outside of the function",
    "eigh": "decompose a constant matrix once, outside of the function",
    "qr": "decompose a constant matrix once, outside of the function",
    "a cond": "choose among two results by jnp.where",
    "an array of key": "draw random numbers outside of the function, and pass them in",
    "division of integers": "divide floating-point numbers and round them down",
    "gather": "interpolate in a table of at most 256 entries",
    "dynamic_slice": "interpolate in a table of at most 256 entries",
    "scatter": "write into arrays of at most 256 entries, or at places that are known while tracing",
}
_USUAL = "write it by arithmetic, products of matrices, jnp.where, and indices that are known while tracing"


def remedy_of(reason: str) -> str:
    """Remedy for a part that has no kernel."""
    return next((text for words, text in _REMEDIES.items() if reason.startswith(words)), _USUAL)


def say_without_kernel(name: str, reason: str) -> None:
    """Log once that a function runs on JAX's operations: the user's function at fault and the remedy, if it is not ours."""
    cause, mark, place = reason.partition(", in ")
    if not mark:
        # A derivative is traced without the places of the function that it belongs to.
        if not mode.has_said(cause):
            mode.say_once(f"{name} runs on JAX's own operations: {reason}")
        return
    # By the user's function, and not by ours that call it, of which there are several.
    mode.say_once(
        f"{place}: {cause} has no kernel, so what calls this function runs on JAX's own operations, several times slower; "
        f"{remedy_of(cause)}",
        subject=cause,
    )
