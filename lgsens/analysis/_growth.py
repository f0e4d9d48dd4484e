"""How far a motion carries a small change of its initial state: what a gradient over a long run is worth.

With δ_n = L_n … L_1 δ_0 the sensitivity of the state at t_n, every derivative of a criterion holds products of the same
L, and grows with them. Along a chaotic motion they grow like exp(σ t): forward and reverse mode still agree, to their
own round-off, but the derivative says nothing of changes larger than exp(−σ t), and once round-off itself has grown to
the size of the scene, at g ε = 1, the motion of which it is the derivative is another one for every compiler.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lgsens._validate import as_count
from lgsens.criteria import grows_exponentially
from lgsens.dynamics import (
    AbstractSystem,
    ConstrainedMass,
    State,
    accelerations,
    consistent_velocity,
    initial_state,
    names_of_all,
    split_velocity,
)
from lgsens.integrate import AbstractIntegrator, GeneralizedAlpha
from lgsens.model import Model
from lgsens.sensitivity import DirectDifferentiation
from lgsens.simulation import as_system, begin, check_integrator, interval, run, throw_if_failed

_DIRECTIONS = 3  # one is nearly orthogonal to the direction that grows with little probability, three never are


class Growth(NamedTuple):
    """How a small change of the initial state grows; `print` it.

    Attributes:
        t: the times [s], shape (n+1,).
        factor: g, the largest change of a coordinate up to each time, in units of 1 rad or the length of the scene,
            for a change of that size of the configuration, and of that size over the run by the velocity, at first;
            shape (n+1,).
        exponential: whether g grows faster than t⁴, by more than 16 times in the second half of the run, shape ().
        horizon: the time at which round-off has grown to the size of the scene, g ε = 1 [s], shape (); inf: later.
    """

    t: Float[Array, " n+1"]
    factor: Float[Array, " n+1"]
    exponential: Bool[Array, ""]
    horizon: Float[Array, ""]

    def __str__(self) -> str:
        grown, end = float(self.factor[-1]), float(self.t[-1])
        said = f"A small change of the initial state grows by {grown:.1e} in {end - float(self.t[0]):.4g} s."
        if not bool(self.exponential):
            return said + " Growth is that of a regular motion."
        middle = len(self.t) // 2
        rate = np.log(grown / float(self.factor[middle])) / (end - float(self.t[middle]))
        said += f" It grows exponentially, by e each {1 / rate:.3g} s: the motion is unstable or chaotic, and its "
        said += (
            f"gradients are dominated by that. They hold for changes of parameters below {1 / grown:.0e} of their size."
        )
        if np.isfinite(float(self.horizon)):
            said += f" From t = {float(self.horizon):.4g} s on the motion itself is one of round-off."
        return said

    __repr__ = __str__


def sensitivity_growth(
    model: Model | AbstractSystem, *, t0=0.0, t1, num_steps: int, integrator: AbstractIntegrator = GeneralizedAlpha()
) -> Growth:
    """How a small change of the initial state grows along a simulation, and whether its gradients are those of chaos.

    Three random changes that the joints allow are followed by the direct differentiation method,

        g(t) = max |δq(t') / scale|,  t' ≤ t,     |δq(t0)| = scale,  |δv(t0)| = scale/(t1 − t0)

    Arguments: as in `simulate`, which it costs about four times.

    Raises as `simulate`. Source: the rate is the largest Lyapunov exponent (Benettin et al., Meccanica 15, 1980).
    """
    system = as_system(model)
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    check_integrator(integrator, num_steps)
    t0, t1 = interval(t0, t1)
    growth, result, details = _growth_jit(system, t0, t1, num_steps, integrator)
    return throw_if_failed(growth, result, details, names_of_all(system))


@eqx.filter_jit
def _growth_jit(system: AbstractSystem, t0, t1, num_steps: int, integrator: AbstractIntegrator):
    initial = initial_state(system, t0)
    group, q0, v0, scale = system.group, initial.state.q, initial.state.v, system.coordinate_scale()

    def motion(x, y):
        q = group.retract(q0, x)
        kkt = ConstrainedMass.of(system, q, t0)
        v = consistent_velocity(system, q, v0 + y, t0, kkt)
        vdot, lam = accelerations(system, q, v, t0, kkt)
        moved = initial._replace(state=State(q=q, v=v, vdot=vdot, lam=lam, a=vdot), kkt=kkt)
        start = begin(integrator.scheme, system, t0, None, moved)
        trajectory, details = run(system, start, t0, t1, num_steps, integrator, DirectDifferentiation())
        return trajectory.states.q, (trajectory.t, trajectory.result, details)

    def followed(random):
        x, _ = split_velocity(system, q0, scale * random[0], t0)
        size = jnp.max(jnp.abs(x) / scale)
        x = x / jnp.where(size > 0.0, size, 1.0)
        y = scale * random[1] / jnp.max(jnp.abs(random[1])) / (t1 - t0)
        zero = jnp.zeros_like(v0)
        q, dq, others = jax.jvp(motion, (zero, zero), (x, y), has_aux=True)
        w = jax.vmap(group.from_ambient)(q, dq)
        return jnp.max(jnp.abs(w) / scale[None], axis=1), others

    random = jax.random.normal(jax.random.key(0), (_DIRECTIONS, 2, scale.shape[0]), scale.dtype)
    sizes, (t, result, details) = jax.vmap(followed, out_axes=(0, None))(random)
    factor = lax.cummax(jnp.max(sizes, axis=0))
    lost = factor * jnp.finfo(factor.dtype).eps >= 1.0
    horizon = jnp.where(jnp.any(lost), t[jnp.argmax(lost)], jnp.inf)
    return Growth(t, factor, grows_exponentially(factor), horizon), result, details
