"""Joints between shafts: gears, and the constant-velocity joint."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_count, axis_field, point_field, require
from lgsens.liegroups import cross, skew
from lgsens.model._constraints import AbstractConstraint, AbstractVelocityConstraint, ConstraintSum, Orthogonality
from lgsens.model._elements import body_fixed
from lgsens.model._frames import ROTATION, Frame, normals
from lgsens.model._joints import AbstractJoint, _coincidence
from lgsens.model._relative import ROTATION_VECTOR, but_for_turns, frames_at
from lgsens.model._signal_fields import prescribed_field, require_ratio
from lgsens.model._signals import AbstractSignal, Prescribed, at_time, prepared
from lgsens.model._turns import unless_whole


class Gearing(AbstractConstraint):
    """Two gears have turned in the ratio ρ against the line d between them: Φ = φ_b − ρ φ_a; λ is a moment on b [N m].

    d may be given, fixed in the inertial frame. With x along d in the reference configuration and orthogonal to the
    axis, and y = e × x, both fixed to a gear, that gear has turned by φ = −atan2(y·d, x·d). Poses tell angles but for
    whole turns, and Φ but for those of `teeth` times itself: these cancel if `teeth` times ρ is an integer.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    first_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    second_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    first_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    second_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    line: Float[Array, "3"] | None
    ratio: Prescribed
    teeth: int = eqx.field(static=True)

    drawn = None
    num_rows = 1

    @property
    def relative(self):
        return self.line is None

    def angles(self, a, b):
        """φ_a and φ_b [rad], but for whole turns."""
        d = b.point(self.point_b) - a.point(self.point_a) if self.line is None else self.line
        turned = lambda frame, x, y: -jnp.arctan2(jnp.sum(frame.axis(y) * d), jnp.sum(frame.axis(x) * d))
        return turned(a, self.first_a, self.second_a), turned(b, self.first_b, self.second_b)

    def branch(self, a, b):
        of_a, _ = self.angles(a, b)
        return of_a if isinstance(self.ratio, AbstractSignal) else unless_whole(self.ratio, self.teeth, of_a)

    def value(self, a, b, t):
        of_a, of_b = self.angles(a, b)
        return but_for_turns(of_b - at_time(self.ratio, t) * of_a, turn=2.0 * jnp.pi / self.teeth)[None]


class FrictionGearing(AbstractVelocityConstraint):
    """Two wheels turn at rates in the ratio ρ, φ̇_b − ρ φ̇_a = 0, as seen from the line between them: of any ratio, over
    any number of turns; λ is a moment on b [N m]."""

    gears: Gearing
    drawn = None
    num_rows = 1

    def fixed(self, kind, bodies="ab"):
        return self.gears.fixed(kind, bodies)

    def rate(self, a, b, va, vb, t):
        moves = lambda frame, v: Frame(v[: ROTATION.start], frame.orientation @ skew(v[ROTATION]))
        of_a, of_b = jax.jvp(self.gears.angles, (a, b), (moves(a, va), moves(b, vb)))[1]
        return (of_b - at_time(self.gears.ratio, t) * of_a)[None]


class GearJoint(AbstractJoint):
    """Two gears turn in a ratio, φ_b = ρ φ_a; 1 equation.

    Their angles are seen from the line between their centres, so from what carries both, which may move, too: sun and
    planet roll on each other. Other joints hold the axes.

    Arguments:
        a, b: names of the two gears; None is the ground, on which a gear is fixed.
        at_a, at_b: their centres in the reference configuration [m], inertial frame, shape (3,): points of their axes,
            the line between which has any direction but those of the axes.
        axis_a, axis_b: directions of their axes, inertial frame, shape (3,), any length > 0.
        ratio: ρ, shape (): turns of `b` about `axis_b` for one of `a` about `axis_a`; of an external pair with
            parallel axes −n_a/n_b for n_a and n_b teeth. Or a signal of time: the angles, not their rates, have its
            ratio at every instant, as a drive of variable ratio has it that is shifted with `a` near the reference.
        teeth: n_b or another count for which ratio · teeth is an integer: gears then turn any number of times. With
            another ratio `a` is within half a turn of the reference, where a run has failed otherwise, and so it is
            **for the derivative by the ratio**: poses do not tell turns, by which that derivative grows. None: no teeth
            but friction, a belt, a variable drive. Not angles but rates are then in the ratio, φ̇_b = ρ φ̇_a, at every
            instant, over any number of turns, and the derivative by it is right. (An equation of velocities, solved by
            dense matrices, as `Rolling`.)
        line: a direction, fixed in the inertial frame, shape (3,), from which the angles are seen instead: of gears on
            one axis, or any that a third part connects, in a housing that does not turn; None: that of the centres.

    The multiplier is the moment of `b` on the mesh about its axis [N m]: its negative drives `b`. Raises `ValueError`
    for a wrong shape, a zero axis, a line along an axis, a zero ratio, or a count below 1. Source: Haug (1989), §3.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    axis_a: Float[Array, "3"] = axis_field("axis_a")
    axis_b: Float[Array, "3"] = axis_field("axis_b")
    ratio: Prescribed | None = prescribed_field("ratio")
    teeth: int | None = eqx.field(static=True, default=1, kw_only=True)
    line: Float[Array, "3"] | None = point_field("line", default=None)

    def __check_init__(self):
        require_ratio("GearJoint", "ratio", self.ratio, "; a gear that does not turn is fixed by another joint")
        if self.teeth is not None:
            as_count(self.teeth, "teeth", ", or None for wheels without teeth")
        for name, axis in (("axis_a", self.axis_a), ("axis_b", self.axis_b)):
            require(
                lambda d, e: np.linalg.norm(np.cross(d, e)) > 1e-6 * np.linalg.norm(d) * np.linalg.norm(e),
                f"GearJoint: the line from `at_a` {self.at_a} to `at_b` {self.at_b}, or `line` {self.line}, is along "
                f"`{name}` {axis}; give the centres of the gears, each on its own axis, and of gears on one axis a "
                "`line` across it.",
                self._line,
                axis,
            )

    assembled = True

    @property
    def _line(self):
        return self.at_b - self.at_a if self.line is None else self.line

    def constraints(self, a, b):
        d = self._line
        marks = []
        for frame, axis in ((a, self.axis_a), (b, self.axis_b)):
            second = cross(axis, d)
            first = cross(second, axis)
            marks += [frame.local_axis(mark / jnp.linalg.norm(mark)) for mark in (first, second)]
        centres = a.local_point(self.at_a), b.local_point(self.at_b)
        gears = Gearing(*centres, *marks, line=self.line, ratio=prepared(self.ratio), teeth=self.teeth or 1)
        return (gears,) if self.teeth else (FrictionGearing(gears),)


class ConstantVelocityJoint(AbstractJoint):
    """Two shafts meet in a point and turn alike whatever the angle between them; 4 equations.

    One is turned into the direction of the other about an axis orthogonal to both, without twist: both see each other
    mirrored in the plane between them, so their angular velocities along themselves are equal. With x, y orthogonal to
    a shaft of each body, the rotation between both is exp(ñ) with n orthogonal to the shaft where its skew part has no
    entry of x and y: (y_a·x_b − x_a·y_b)/2 = 0.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: where the shafts meet in the reference configuration [m], inertial frame, shape (3,).
        axis_a: direction of the shaft of `a`, inertial frame, shape (3,), any length > 0.
        axis_b: direction of the shaft of `b` in the same sense, shape (3,); None: that of `a`, the joint is straight.

    The multipliers are the force of `b` on `a` [N], and the moment about the shafts [N m] for a straight joint, 2/(1 +
    cos β) of it at an angle β. Raises `ValueError` for a wrong shape, a zero axis, or shafts at a right angle or more.
    Source: Seherr-Thoss, Schmelz & Aucktor, Universal Joints and Driveshafts (2nd ed. 2006), chapter 2.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis_a: Float[Array, "3"] = axis_field("axis_a")
    axis_b: Float[Array, "3"] | None = point_field("axis_b", default=None)

    def __check_init__(self):
        if self.axis_b is not None:
            require(
                lambda a, b: np.dot(a, b) > 0,
                f"ConstantVelocityJoint: `axis_a` {self.axis_a} and `axis_b` {self.axis_b} are at a right angle or "
                "more; give both in the same sense, from one shaft to the other.",
                self.axis_a,
                self.axis_b,
            )

    assembled = True
    coordinates = ROTATION_VECTOR
    frames = frames_at

    def constraints(self, a, b):
        unit, *across_a = normals(self.axis_a)
        shaft_b = unit if self.axis_b is None else self.axis_b / jnp.linalg.norm(self.axis_b)
        bend = cross(unit, shaft_b)  # the shortest rotation is v + w × v + w × (w × v)/(1 + c)
        turned = lambda v: v + cross(bend, v) + cross(bend, cross(bend, v)) / (1.0 + jnp.sum(unit * shaft_b))
        (x_a, y_a), (x_b, y_b) = across_a, map(turned, across_a)
        pairs = ((-0.5 * x_a, y_b), (0.5 * y_a, x_b))
        xy, yx = (Orthogonality(a.local_axis(of_a), b.local_axis(of_b)) for of_a, of_b in pairs)
        return (_coincidence(a, b, self.at), ConstraintSum((xy, yx)))
