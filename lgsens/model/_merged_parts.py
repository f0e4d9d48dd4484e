"""The parts of merged bodies: their motion, and what their fixed joints carry."""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._xla import one_program
from lgsens.dynamics import AbstractSystem, full_jacobian
from lgsens.liegroups import Pose
from lgsens.model._frames import BODY_DIM, ROTATION, Frame, motion_at

System = TypeVar("System", bound=AbstractSystem)


class Parts(eqx.Module, Generic[System]):
    """A scene whose fixed joints are merged, as a scene of its parts.

    With the pose (c, C) of the frame of a part in that of its body,

        x_p = x + R c,   R_p = R C,   ẋ_p = ẋ + R (Ω × c),   Ω_p = Cᵀ Ω,
        ẍ_p = ẍ + R (Ω̇ × c + Ω × (Ω × c)),   Ω̇_p = Cᵀ Ω̇.

    The equations of motion of the parts that one fixed joint after the other holds together determine the multipliers
    μ of these joints: r_p + B_pᵀ μ = 0 with r_p the residual of the parts without them, whence B_p B_pᵀ μ = −B_p r_p.
    """

    system: System  # the equations of the parts, of which each fixed joint is one
    offset: Frame  # (c, C) of all parts, leading axis P
    body: tuple[int | None, ...] = eqx.field(static=True)  # the number of the body of each part; None: the ground
    free: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # the coordinates, 0 to 5, of each part
    fixed: tuple[tuple[str, ...], ...] = eqx.field(static=True)  # the merged joints, by body

    def motion(self, q: Pose, twist, rate):
        """q, v, v̇ of the parts, from poses, [ẋ, Ω] and their rates of change of the bodies; along leading axes."""
        lead, (c, turn) = q.position.shape[:-2], self.offset

        def of_bodies(array, ground):
            """The entries of the bodies of the parts; the ground comes after the last body."""
            ground = jnp.broadcast_to(ground, (*lead, 1, *ground.shape))
            last = array.shape[len(lead)]
            index = np.asarray([last if body is None else body for body in self.body])
            return jnp.take(jnp.concatenate([array, ground], axis=len(lead)), index, axis=len(lead))

        at_rest = jnp.zeros(BODY_DIM, c.dtype)
        position = of_bodies(q.position, jnp.zeros(3, c.dtype))
        orientation = of_bodies(q.orientation, jnp.eye(3, dtype=c.dtype))
        twist, rate = of_bodies(twist, at_rest), of_bodies(rate, at_rest)

        to_part = lambda x: jnp.einsum("pji,...pj->...pi", turn, x)
        spin, change = twist[..., ROTATION], rate[..., ROTATION]
        position, velocity, acceleration = motion_at(c, position, orientation, twist, rate)
        return (
            Pose(position, orientation @ jnp.broadcast_to(turn, orientation.shape)),
            self._coordinates(velocity, to_part(spin)),
            self._coordinates(acceleration, to_part(change)),
        )

    def _coordinates(self, linear, angular):
        both = jnp.concatenate([linear, angular], axis=-1)
        flat = both.reshape(*both.shape[:-2], both.shape[-2] * BODY_DIM)
        return flat[..., np.asarray([i * BODY_DIM + own for i, free in enumerate(self.free) for own in free], int)]

    @property
    def joints(self) -> tuple[str, ...]:
        """All merged joints."""
        return tuple(name for own in self.fixed for name in own)

    @partial(one_program, static_argnums=1)
    def with_fixed(self, joint: str, q, v, vdot, lam, t):
        """λ of the parts with μ of a fixed joint, and of those of the same body, in their rows; at one instant."""
        names = np.asarray(self.system.constraint_names)
        (group,) = [own for own in self.fixed if joint in own]
        rows = np.concatenate([np.flatnonzero(names == name) for name in group])
        residual = self.system.residual(q, v, vdot, lam, t)
        jacobian = full_jacobian(self.system, q, t)[rows]
        found = jnp.linalg.solve(jacobian @ jacobian.T, -(jacobian @ residual))
        return jnp.zeros(len(names), lam.dtype).at[rows].set(found)

    def multiplier(self, joint: str, rows_between: Callable[[str], np.ndarray], q, v, vdot, lam, t):
        """The multipliers of a merged joint, along leading axes of q, v, v̇ of the parts and of λ between the merged
        bodies, where those of each other joint are at `rows_between`."""
        whole: Any = self.system
        places, own_places = [np.zeros(0, int)], [np.zeros(0, int)]
        for name in sorted(set(whole.constraint_names) - set(self.joints)):
            rows, own = whole.multiplier_rows(name), rows_between(name)
            if len(rows) != len(own):
                raise ValueError(
                    f"`multiplier`: what {joint!r} carries is not determined: joint {name!r} has {len(rows)} "
                    f"equations between the bodies that it names, and {len(own)} between the merged ones. Leave "
                    "`merge_fixed` out and remove the equations that are redundant then."
                )
            places.append(rows)
            own_places.append(own)
        others = jnp.zeros((*lam.shape[:-1], len(whole.constraint_names)), lam.dtype)
        others = others.at[..., np.concatenate(places)].set(lam[..., np.concatenate(own_places)])
        complete = partial(self.with_fixed, joint)
        for _ in lam.shape[:-1]:
            complete = jax.vmap(complete)
        return complete(q, v, vdot, others, t)[..., whole.multiplier_rows(joint)]
