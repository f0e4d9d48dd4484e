"""Rubber bushings in place of joints: rates or curves along and about three axes."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, is_concrete, point_field, require
from lgsens.liegroups import cross
from lgsens.model._forces import AbstractConnection
from lgsens.model._joints import FixedJoint, RevoluteJoint, SphericalJoint
from lgsens.model._loads import BushingLoad
from lgsens.model._signals import AbstractSignal, prepared
from lgsens.model._turning_loads import CurveBushingLoad, Curves, LoadSum, RotationLoad

_CURVES = ("springs", "dampers")
_SOFT = 1e-2  # of the largest rotational rate: below, a joint turns


class Bushing(AbstractConnection):
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
        springs, dampers: curves in place of rates, or added to them: of each axis f_i [N] over u_i [m] and g_i over
            u̇_i [m/s], a signal of it in place of time, or None; three of them; None: none.
            `Sampled(places, forces, "monotone")` goes through points, C¹, and straight on outside of them.
        rotational_springs, rotational_dampers: likewise, moments [N m] over φ_i [rad] and φ̇_i [rad/s].
        axes: the first of its axes, and a direction in the plane of the first and the second, inertial frame, shape
            (2, 3), any lengths > 0; None: x, y and z of the inertial frame.

    With nothing rotational it resists no rotation, and costs nothing for it, nor for curves that it does not have. It
    is as smooth as its curves, its tangents one derivative less. The moments do the work −m·φ̇: on b acts −m but for
    terms of second order in φ. The damper turns with a, and forces act at the point on b: with damping a and b are not
    to be exchanged where both turn much. A force between bodies that is far stiffer than the others makes explicit
    integrators take as many more steps; generalized-α does not mind. Raises `ValueError` for wrong shapes, axes that
    are none, and curves that are not three signals or None. Source: Masarati & Morandini (2010),
    doi:10.1007/s11044-010-9194-y.
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
    springs: Curves | None = eqx.field(default=None, kw_only=True, metadata={"over": "length"})
    dampers: Curves | None = eqx.field(default=None, kw_only=True, metadata={"over": "rate"})
    rotational_springs: Curves | None = eqx.field(default=None, kw_only=True, metadata={"over": "angle"})
    rotational_dampers: Curves | None = eqx.field(default=None, kw_only=True, metadata={"over": "rate"})
    axes: Float[Array, "2 3"] | None = eqx.field(
        default=None, kw_only=True, converter=lambda axes: None if axes is None else as_float(axes, (2, 3), "`axes`")
    )

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
        require(
            lambda axes: np.linalg.norm(np.cross(*axes)) > 1e-6 * np.prod(np.linalg.norm(axes, axis=1)),
            lambda: f"Bushing: `axes` {self.axes} lie along each other or are zero; give two directions.",
            np.eye(2, 3) if self.axes is None else self.axes,
        )

    @property
    def _turns(self) -> bool:
        """Whether it resists rotation."""
        return self.rotational_stiffness is not None or self.rotational_springs is not None

    @property
    def preload_shape(self):
        return (6,) if self._turns else (3,)

    def with_preload(self, preload):
        if not self._turns:
            return dataclasses.replace(self, preload=preload)
        return dataclasses.replace(self, preload=preload[:3], rotational_preload=preload[3:])

    @property
    def preload_rates(self):
        if not self._turns:
            return None
        slopes = self.stiffness + _slopes(self.springs, self.at.dtype)
        turning = jnp.zeros_like(self.at) if self.rotational_stiffness is None else self.rotational_stiffness
        return jnp.concatenate([slopes, turning + _slopes(self.rotational_springs, self.at.dtype)])

    @property
    def triad(self) -> Float[Array, "3 3"]:
        """Unit vectors along its axes as columns, inertial frame."""
        first, second = jnp.eye(2, 3, dtype=self.at.dtype) if self.axes is None else self.axes
        third = cross(first, second)
        columns = jnp.stack([first, cross(third, first), third], axis=1)
        return columns / jnp.linalg.norm(columns, axis=0, keepdims=True)

    def as_joint(self, kind, what):
        known = ("spherical", "revolute", "fixed")
        if kind is not None and kind not in known:
            raise ValueError(f"{what}: `kind` must be one of {known} or None, got {kind!r}.")
        free = self._free_turns(kind, what)
        if not len(free):
            joint = FixedJoint(self.a, self.b, at=self.at)
        elif len(free) == 1:
            joint = RevoluteJoint(self.a, self.b, at=self.at, axis=self.triad[:, free[0]])
        else:
            joint = SphericalJoint(self.a, self.b, at=self.at)
        yielding = self.with_preload(jnp.zeros(self.preload_shape, self.at.dtype))
        blocked = yielding._about([i for i in range(3) if i not in free])
        if not self._turns or not len(free):
            return joint, blocked, None
        none, still = jnp.zeros_like(self.at), {"springs": None, "dampers": None}
        left = dataclasses.replace(self._about(free), stiffness=none, damping=none, preload=none, **still)
        return joint, blocked, left

    def _free_turns(self, kind: str | None, what: str) -> list[int]:
        """About which of its axes the joint that it becomes lets its bodies turn."""
        if kind in ("spherical", "fixed") or not self._turns:
            return [] if kind == "fixed" else [0, 1, 2]
        rates = self.preload_rates
        if not is_concrete(rates):
            raise ValueError(f"{what}: the rates of this bushing are not known here; give `kind`.")
        turning = np.asarray(rates)[3:]
        free = [int(i) for i in np.flatnonzero(turning <= _SOFT * turning.max())]
        if kind == "revolute":
            return [int(np.argmin(turning))]
        return free if len(free) == 1 else [0, 1, 2] if len(free) > 1 else []

    def _about(self, axes: Sequence[int]) -> "Bushing":
        """The same, resisting rotations about some of its axes only."""
        on = jnp.asarray([i in axes for i in range(3)], self.at.dtype)
        of = lambda rate: None if rate is None or not len(axes) else on * rate
        curves = lambda given: given and tuple(curve if i in axes else None for i, curve in enumerate(given))
        turns = {name: of(getattr(self, f"rotational_{name}")) for name in ("stiffness", "damping", "preload")}
        turns |= {name: curves(getattr(self, f"rotational_{name}")) if len(axes) else None for name in _CURVES}
        return dataclasses.replace(self, **{f"rotational_{name}": value for name, value in turns.items()})

    def load(self, a, b):
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
        ready = lambda curves: None if curves is None else tuple(map(prepared, curves))
        if self.springs is not None or self.dampers is not None:
            load = CurveBushingLoad(load, back, ready(self.springs), ready(self.dampers))
        about = self.rotational_stiffness, self.rotational_damping, self.rotational_preload
        curves = {"springs": ready(self.rotational_springs), "dampers": ready(self.rotational_dampers)}
        if any(numbers is not None for numbers in (*about, *curves.values())):
            k, c, m = (jnp.zeros_like(self.at) if numbers is None else numbers for numbers in about)
            load = LoadSum((load, RotationLoad(triads[0], triads[1], k, c, m, **curves)))
        return load


def _slopes(curves: Curves | None, dtype) -> Float[Array, "3"]:
    """The rates of curves where they begin to yield."""
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    slope = lambda curve: zero if curve is None else jax.jvp(prepared(curve), (zero,), (one,))[1]
    return jnp.stack([slope(curve) for curve in curves or (None, None, None)])
