"""What a run in steps of any size continues from.

Generalized-α has a state that belongs to the size h_n of the step that led to it, and says what steps of another size
begin with, in powers of their ratio r (`AbstractAlphaBegin.resized`). With r = h/h_n it is in powers of h. A state of
schemes that remember no step is the same in steps of any size, but for round-off.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate import GeneralizedAlpha, Start


def start_in_any_steps(system: AbstractSystem, t: Float[Array, " n"], state: State, at: Float[Array, ""]) -> Start:
    """That of a state at one of the times t, of which several may be the same."""
    before = jnp.max(jnp.where(t < at, t, -jnp.inf))
    size = jnp.where(at > t[0], at - before, jnp.min(jnp.where(t > at, t, jnp.inf)) - at)
    by_ratio = GeneralizedAlpha().resized(system, state, at)
    per = lambda power, part: None if part is None else part / size**power
    return by_ratio._replace(v_2=per(2, by_ratio.v_2), a_1=per(1, by_ratio.a_1))
