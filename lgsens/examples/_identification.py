"""System identification: masses, stiffness, damping and a hardpoint of the four-bar from noisy accelerations."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float
from lgsens.examples._mechanisms import four_bar
from lgsens.simulation import simulate


class AccelerationTest(eqx.Module):
    """Accelerometers at the centres of coupler and rocker of a four-bar that is let go, and what is to be found out.

    The crank has been weighed and the links measured; unknown are the masses of coupler and rocker [kg], the stiffness
    [N/m] and damping [N s/m] of the spring and the point (px, py) [m] where it is hung up. Without one known mass only
    ratios could be found: the motion stays the same where all masses, k and c grow alike.

    Arguments:
        deviation: standard deviation σ of the noise of every reading [m/s²].
        t1: duration [s]. num_steps: steps of the simulation, static; a reading at each time.
    """

    deviation: Float[Array, ""] = eqx.field(default=0.05, converter=lambda value: as_float(value, (), "`deviation`"))
    t1: float = eqx.field(static=True, default=0.75)
    num_steps: int = eqx.field(static=True, default=150)

    @property
    def truth(self) -> dict[str, float]:
        """What the test bench has."""
        return {"m3": 2.0, "m4": 1.5, "k": 200.0, "cd": 2.0, "px": 0.45, "py": 1.1}

    @property
    def guess(self) -> dict[str, float]:
        """Where the search begins: 15 to 30 % off, the point by 3 cm. From twice as far it ends elsewhere."""
        return {"m3": 1.7, "m4": 1.8, "k": 230.0, "cd": 1.4, "px": 0.48, "py": 1.07}

    def accelerations(self, parameters) -> Float[Array, "n 4"]:
        """Those of both centres in the plane, without noise [m/s²]."""
        trajectory = simulate(four_bar(**parameters), t1=self.t1, num_steps=self.num_steps, throw=False)
        return jnp.concatenate([trajectory.body(name).acceleration[:, :2] for name in ("coupler", "rocker")], axis=1)

    def measure(self, key: Array, parameters) -> Float[Array, "n 4"]:
        """The readings, with independent Gaussian noise."""
        exact = self.accelerations(parameters)
        return exact + self.deviation * jax.random.normal(key, exact.shape, exact.dtype)

    def residual(self, parameters, readings: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
        """(model − readings)/σ, as `lgsens.optimize.least_squares` wants it."""
        return (self.accelerations(parameters) - readings) / self.deviation
