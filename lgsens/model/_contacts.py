"""What pushes and does not pull, as stacked numbers: a tyre that lifts off, and a point on a plane."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.liegroups import cross
from lgsens.model._elements import body_fixed
from lgsens.model._frames import BODY_B, ROTATION, Frame, separation_force, separation_stiffness
from lgsens.model._loads import AbstractClosedFormLoad, AbstractLoad, LoadTangents
from lgsens.model._signals import AbstractSignal


def ramp(x, rounding) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """max(x, 0) with two continuous derivatives, and the first one: rounded within ±w by (x + w)³ (3w − x)/(16 w³)."""
    s = jnp.clip(x / rounding, -1.0, 1.0) + 1.0
    return rounding * s**3 * (4.0 - s) / 16.0 + jnp.maximum(x - rounding, 0.0), s**2 * (3.0 - s) / 4.0


class TyreLoad(AbstractClosedFormLoad):
    """A vertical spring between the road and a point of b: F_z = F₀ + k (z_road(t) − z + ℓ₀), along the inertial z.

    With e_z the vertical, d the point and D_b = [I, −R_b X̃_b] its gradient: Q_b = F_z D_bᵀ e_z,
    ∂Q/∂q = −k D_bᵀ e_z e_zᵀ D_b + D_q(Dᵀ f)|_{f = F_z e_z}. A tyre that lifts off has k ramp(F_z/k) for F_z.
    """

    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: Float[Array, ""]
    free_radius: Float[Array, ""]
    preload: Float[Array, ""]
    road: AbstractSignal
    rounding: Float[Array, ""] | None = None  # w of `ramp`; None: the tyre also pulls

    drawn = "wheel"

    def _force(self, b, t):
        """F_z and −∂F_z/∂z."""
        force = self.preload + self.stiffness * (self.road(t) + self.free_radius - b.point(self.point_b)[2])
        if self.rounding is None:
            return force, self.stiffness
        squeezed, slope = ramp(force / self.stiffness, self.rounding)
        return self.stiffness * squeezed, self.stiffness * slope

    def measure(self, a, b, va, vb, t) -> Float[Array, ""]:
        return self._force(b, t)[0]

    def _vertical(self, a, b):
        up = jnp.asarray([0.0, 0.0, 1.0], self.point_b.dtype)
        return jnp.concatenate([jnp.zeros(BODY_B.start, up.dtype), up, cross(self.point_b, b.orientation[2])])

    def force(self, a, b, va, vb, t):
        return self.measure(a, b, va, vb, t) * self._vertical(a, b)

    def tangents(self, a, b, va, vb, t):
        vertical, (force, stiffness) = self._vertical(a, b), self._force(b, t)
        force = force * jnp.asarray([0.0, 0.0, 1.0], vertical.dtype)
        geometric = separation_stiffness(a, b, jnp.zeros_like(self.point_b), self.point_b, force)
        return LoadTangents(geometric - stiffness * jnp.outer(vertical, vertical), None)


class PlaneContactLoad(AbstractLoad):
    """F = k ramp(x, w) ramp(1 + c ẋ, ½) along the normal n of a, x = −n·d: Hunt & Crossley's law, which never pulls.

    d is from the point of a, on its plane, to that of b; friction −μ F u/√(u² + u₀²) against the slip u = ḋ − n (n·ḋ)
    in the frame of a. Both act at the point of b.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    normal_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    rounding: Float[Array, ""]
    coefficient: Float[Array, ""] | None  # μ
    slip_speed: Float[Array, ""] | None  # u₀

    balanced = True
    drawn = None

    def _at(self, a: Frame, b: Frame, va, vb):
        """Where it is in a, n, the velocity of the point of b in a, inertial frame, and F."""
        speed = lambda frame, v, point: v[: ROTATION.start] + frame.axis(cross(v[ROTATION], point))
        at, n = b.point(self.point_b), a.axis(self.normal_a)
        local = a.local_point(at)
        rate = speed(b, vb, self.point_b) - speed(a, va, local)
        x = -jnp.sum(n * (at - a.point(self.point_a)))
        push = ramp(1.0 - self.damping * jnp.sum(n * rate), jnp.full_like(x, 0.5))[0]
        return local, n, rate, self.stiffness * ramp(x, self.rounding)[0] * push

    def measure(self, a, b, va, vb, t) -> Float[Array, ""]:
        return self._at(a, b, va, vb)[-1]

    def force(self, a, b, va, vb, t):
        local, n, rate, size = self._at(a, b, va, vb)
        f = size * n
        if self.coefficient is not None and self.slip_speed is not None:
            slip = rate - jnp.sum(n * rate) * n
            f -= size * self.coefficient / jnp.sqrt(jnp.sum(slip * slip) + self.slip_speed**2) * slip
        return separation_force(a, b, local, self.point_b, f)
