"""Rubber bushings in place of joints."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, point_field, require
from lgsens.liegroups import cross
from lgsens.model._forces import AbstractForce, Attached, _frame
from lgsens.model._loads import BushingLoad
from lgsens.model._turning_loads import FullBushingLoad, RotationLoad


class Bushing(AbstractForce):
    """A rubber bushing in place of a joint: a spring and damper along, and about, each of three axes fixed to body a.

        g = g₀ + K u + C u̇,     u the vector from the point on a to the point on b, in the frame of a
        m = m₀ + K_r φ + C_r φ̇,     φ the rotation vector of b in a, |φ| < π, along the same axes

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: where it is in the reference configuration [m], inertial frame, shape (3,): both points are there.
        stiffness: the spring stiffnesses [N/m] along its axes in the reference configuration, shape (3,). The axes turn
            with a.
        damping: the damping along the same axes [N s/m], shape (3,).
        preload: the force g₀ that pulls b to a in the reference configuration [N], along the same axes, shape (3,).
        rotational_stiffness, rotational_damping: K_r [N m/rad] and C_r [N m s/rad] about the same axes, shape (3,);
            None: 0.
        rotational_preload: the moment m₀ that turns b back there [N m], about the same axes, shape (3,); None: 0.
        axes: the first of its axes, and a direction in the plane of the first and the second, inertial frame, shape
            (2, 3), any lengths > 0; None: x, y and z of the inertial frame.

    With no rotational numbers it resists no rotation, and costs nothing for it. The moments do the work −m·φ̇: on b
    acts −m but for terms of second order in φ. A force between bodies that is stiffer by orders than the others makes
    explicit integrators take as many more steps; generalized-α does not mind. Raises `ValueError` for wrong shapes, or
    axes that are none.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    stiffness: Float[Array, "3"] = point_field("stiffness")
    damping: Float[Array, "3"] = point_field("damping", default=(0.0, 0.0, 0.0))
    preload: Float[Array, "3"] = point_field("preload", default=(0.0, 0.0, 0.0))
    rotational_stiffness: Float[Array, "3"] | None = point_field("rotational_stiffness", default=None)
    rotational_damping: Float[Array, "3"] | None = point_field("rotational_damping", default=None)
    rotational_preload: Float[Array, "3"] | None = point_field("rotational_preload", default=None)
    axes: Float[Array, "2 3"] | None = eqx.field(
        default=None, kw_only=True, converter=lambda axes: None if axes is None else as_float(axes, (2, 3), "`axes`")
    )

    def __check_init__(self):
        require(
            lambda axes: np.linalg.norm(np.cross(*axes)) > 1e-6 * np.prod(np.linalg.norm(axes, axis=1)),
            f"Bushing: `axes` {self.axes} lie along each other or are zero; give two directions.",
            np.eye(2, 3) if self.axes is None else self.axes,
        )

    @property
    def bodies(self):
        return (self.a, self.b)

    @property
    def preload_shape(self):
        return (3,) if self.rotational_stiffness is None else (6,)

    def with_preload(self, preload):
        if self.rotational_stiffness is None:
            return dataclasses.replace(self, preload=preload)
        return dataclasses.replace(self, preload=preload[:3], rotational_preload=preload[3:])

    @property
    def preload_rates(self):
        if self.rotational_stiffness is None:
            return None
        return jnp.concatenate([self.stiffness, self.rotational_stiffness])

    @property
    def triad(self) -> Float[Array, "3 3"]:
        """Unit vectors along its axes as columns, inertial frame."""
        first, second = jnp.eye(2, 3, dtype=self.at.dtype) if self.axes is None else self.axes
        third = cross(first, second)
        columns = jnp.stack([first, cross(third, first), third], axis=1)
        return columns / jnp.linalg.norm(columns, axis=0, keepdims=True)

    def loads(self, bodies):
        a, b = (_frame(bodies, name, self.at.dtype) for name in (self.a, self.b))
        triads = [frame.orientation.T for frame in (a, b)]
        if self.axes is not None:
            triads = [triad @ self.triad for triad in triads]
        back = triads[0]
        load = BushingLoad(
            point_a=a.local_point(self.at),
            point_b=b.local_point(self.at),
            stiffness=(back * self.stiffness[None]) @ back.T,
            damping=(back * self.damping[None]) @ back.T,
            preload=back @ self.preload,
        )
        about = self.rotational_stiffness, self.rotational_damping, self.rotational_preload
        if any(numbers is not None for numbers in about):
            about = (jnp.zeros_like(self.at) if numbers is None else numbers for numbers in about)
            load = FullBushingLoad(load, RotationLoad(*triads, *about))
        return (Attached(load, self.a, self.b),)
