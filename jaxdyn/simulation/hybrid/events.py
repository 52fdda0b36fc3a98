"""The events of a motion with modes."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdyn.compile.known import is_concrete


class Events(eqx.Module):
    """Events of a motion in their order; arrays of a fixed length, filled up behind the last one.

    - `time` (ne,), s, NaN behind the last; differentiable. `index` (ne,) among `names`, -1 behind the last.
    - `names`: "<element>: <kind>". A contact's kinds are "touch", "release"; "stick" and "slip" are of friction; a "turn" is one
      from sliding to sliding the other way, or of the normal force of a friction that holds on both sides.
    - `count` (): how many there were. What happens at the same time has one entry for each element, the one that was found
      first in front.
    """

    time: Float[Array, "*batch ne"]
    index: Int[Array, "*batch ne"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def count(self) -> Int[Array, "*batch"]:
        """Number of events."""
        return (self.index >= 0).sum(-1)

    @property
    def name(self) -> np.ndarray:
        """Names (ne,) of the events, "" behind the last. **Raises:** ValueError inside of `jax.jit`, where there are no texts."""
        if not is_concrete(self.index):
            raise ValueError(
                "events.name are texts, which a traced program does not have; take events.index and events.names"
            )
        return np.array([*self.names, ""], dtype=object)[np.asarray(jax.device_get(self.index))]

    def times(self, name: str) -> np.ndarray:
        """Times of the events of one name, of a motion that is no batch.

        **Raises:** ValueError for a name that is none.
        """
        if name not in self.names:
            raise ValueError(f"events: there is no {name!r}; choose from {list(self.names)}")
        return np.asarray(self.time)[self.name == name]
