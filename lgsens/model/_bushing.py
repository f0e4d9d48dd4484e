"""Rubber bushings: rates or curves along and about three axes."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import point_field
from lgsens.model._forces import AbstractForce, Attached, _frame
from lgsens.model._loads import BushingLoad
from lgsens.model._signals import AbstractSignal, prepared
from lgsens.model._turning_loads import CurveBushingLoad, Curves, LoadSum, RotationLoad


class Bushing(AbstractForce):
    """A rubber bushing in place of a joint: a spring and damper along, and about, each of three axes fixed to body a.

        g = g₀ + K u + C u̇,     u the vector from the point on a to the point on b, in the frame of a
        m = m₀ + K_r φ + C_r φ̇,     φ the rotation vector of b in a, |φ| < π, along the same axes

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: where it is in the reference configuration [m], inertial frame, shape (3,): both points are there.
        stiffness: the spring stiffnesses [N/m] along x, y and z of the inertial frame in the reference
            configuration, shape (3,). The axes turn with a.
        damping: the damping along the same axes [N s/m], shape (3,).
        preload: the force g₀ that pulls b to a in the reference configuration [N], inertial frame, shape (3,).
        rotational_stiffness, rotational_damping: K_r [N m/rad] and C_r [N m s/rad] about x, y and z of the inertial
            frame in the reference configuration, shape (3,); None: 0.
        rotational_preload: the moment m₀ that turns b back there [N m], inertial frame, shape (3,); None: 0.
        springs, dampers: curves in place of rates, or added to them: of each axis f_i [N] over u_i [m] and g_i over
            u̇_i [m/s], a signal of it in place of time, or None; three of them; None: none.
            `Sampled(places, forces, "monotone")` goes through points, C¹, and straight on outside of them.
        rotational_springs, rotational_dampers: likewise, moments [N m] over φ_i [rad] and φ̇_i [rad/s].

    With nothing rotational it resists no rotation, and costs nothing for it, nor for curves that it does not have. It
    is as smooth as its curves, its tangents one derivative less. The moments do the work −m·φ̇: on b acts −m but for
    terms of second order in φ. A force between bodies that is stiffer by orders than the others makes explicit
    integrators take as many more steps; generalized-α does not mind. Raises `ValueError` for wrong shapes, and for
    curves that are not three signals or None. Source: Masarati & Morandini (2010), doi:10.1007/s11044-010-9194-y.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    stiffness: Float[Array, "3"] = point_field("stiffness", default=(0.0, 0.0, 0.0))
    damping: Float[Array, "3"] = point_field("damping", default=(0.0, 0.0, 0.0))
    preload: Float[Array, "3"] = point_field("preload", default=(0.0, 0.0, 0.0))
    rotational_stiffness: Float[Array, "3"] | None = point_field("rotational_stiffness", default=None)
    rotational_damping: Float[Array, "3"] | None = point_field("rotational_damping", default=None)
    rotational_preload: Float[Array, "3"] | None = point_field("rotational_preload", default=None)
    springs: Curves | None = eqx.field(default=None, kw_only=True)
    dampers: Curves | None = eqx.field(default=None, kw_only=True)
    rotational_springs: Curves | None = eqx.field(default=None, kw_only=True)
    rotational_dampers: Curves | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        for name in ("springs", "dampers", "rotational_springs", "rotational_dampers"):
            curves = getattr(self, name)
            known = curves is None or (
                isinstance(curves, tuple)
                and len(curves) == 3
                and all(curve is None or isinstance(curve, AbstractSignal) for curve in curves)
            )
            if not known:
                raise ValueError(
                    f"Bushing: `{name}` must be a tuple of three, each a signal (Sampled, Polynomial, …) or None, got "
                    f"{curves!r}; constant rates are `stiffness` and `damping`."
                )

    @property
    def bodies(self):
        return (self.a, self.b)

    preload_shape = (3,)

    def loads(self, bodies):
        a, b = (_frame(bodies, name, self.at.dtype) for name in (self.a, self.b))
        back = a.orientation.T
        load = BushingLoad(
            point_a=a.local_point(self.at),
            point_b=b.local_point(self.at),
            stiffness=(back * self.stiffness[None]) @ a.orientation,
            damping=(back * self.damping[None]) @ a.orientation,
            preload=a.local_axis(self.preload),
        )
        ready = lambda curves: None if curves is None else tuple(map(prepared, curves))
        if self.springs is not None or self.dampers is not None:
            load = CurveBushingLoad(load, back, ready(self.springs), ready(self.dampers))
        about = self.rotational_stiffness, self.rotational_damping, self.rotational_preload
        curves = {"springs": ready(self.rotational_springs), "dampers": ready(self.rotational_dampers)}
        if any(numbers is not None for numbers in (*about, *curves.values())):
            k, c, m = (jnp.zeros_like(self.at) if numbers is None else numbers for numbers in about)
            load = LoadSum((load, RotationLoad(back, b.orientation.T, k, c, m, **curves)))
        return (Attached(load, self.a, self.b),)
