"""Joints: what they say of their derivatives, against what follows from their equation."""

from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import as_float
from lgsens.model import (
    AbstractClosedFormConstraint,
    AbstractConstraint,
    AbstractJoint,
    AbstractRows,
    AbstractVelocityConstraint,
    RigidBody,
    carried,
    constraint_force,
    constraint_jacobian,
    constraint_stiffness,
)
from lgsens.testing._poses import DIM, ScenePoses, displaced, same, slope, vanishes
from lgsens.testing._report import Check, Report, worst
from lgsens.testing._sensitivities import check_sensitivities

RANK = 1e-8  # singular values below this share of the largest are zero: the square root of round-off


def check_joint(
    joint: AbstractJoint | AbstractRows,
    *,
    bodies: Mapping[str, RigidBody] | None = None,
    length: float = 1.0,
    t: float = 0.0,
    poses: int = 3,
    seed: int = 0,
) -> Report:
    """Check a joint, or one basic constraint, against its equation Φ.

        δΦ = B δx,     K = ∂(Bᵀλ)/∂x at fixed λ

    at random poses that need not satisfy it: B and K by autodiff under the retraction R exp(θ̃) and by differences; of a
    constraint in closed form, `jacobian`, `force` and `geometric_stiffness` against autodiff; of any, that B and K are
    zero outside of what it `acts_on` and what is `coupled`, and that Φ on a part of a merged body is that in the frame
    of the part, if it says what of it is fixed to bodies (`body_fixed`). Φ, Bᵀλ and K by every number of it, as
    `check_sensitivities` does. Of rows A v + b of velocity level A in place of B, the same at any v. Of a joint, in the
    reference configuration: Φ = 0 if it says `assembled`, and B of full rank, so that its equations are independent.

    Arguments:
        joint: an `AbstractJoint`, an `AbstractConstraint` or an `AbstractVelocityConstraint`.
        bodies: the bodies that a joint names, in its reference configuration; None: bodies at random poses.
        length: size of the scene [m], shape (): random poses and steps of differences are in proportion.
        t: the time at which what is prescribed is taken [s].
        poses: how many random poses.
        seed: of poses and multipliers.

    Returns a `Report`; a row holds the worst of all poses. Raises `ValueError` for a Φ that has not `num_rows` entries.
    """
    scene, time = ScenePoses(seed, length), as_float(t, (), "`t`")
    is_joint = isinstance(joint, AbstractJoint)
    names = (joint.a, joint.b) if is_joint else ("a", "b")
    bodies = scene.bodies([name for name in names if name is not None]) if bodies is None else bodies
    (a, b), free = scene.ends(*names, bodies)

    def elements_of(joint) -> tuple[AbstractRows, ...]:
        return joint.constraints(a, b) if is_joint else (joint,)

    elements = elements_of(joint)
    labels = [f"{i + 1} {type(e).__name__}: " for i, e in enumerate(elements)] if is_joint else [""]
    multipliers = []
    for label, element in zip(labels, elements):
        rows = jax.eval_shape(_said, element, a, b, jnp.zeros(DIM, scene.dtype), time).shape
        if rows != (element.num_rows,):
            said = "value" if isinstance(element, AbstractConstraint) else "rate"
            raise ValueError(
                f"{label or f'{type(element).__name__}: '}`{said}` has shape {rows}, `num_rows` is {element.num_rows}."
            )
        multipliers.append(jnp.asarray(scene.rng.standard_normal(rows), scene.dtype))
    starts, velocity = [scene.displacement(free) for _ in range(poses)], scene.displacement(free)
    (part,) = ScenePoses(seed + 1, length).frames(1)

    checks: list[Check] = list(_reference(joint, scene, a, b, time, free)) if is_joint else []
    for label, element, lam in zip(labels, elements, multipliers):
        program = _program(element, lam, velocity, time, free, part)
        for start in starts:
            first, second = displaced(a, b, start)
            found = scene.sampled(program(scene.points(free), first, second), free)
            own = isinstance(element, AbstractClosedFormConstraint | AbstractVelocityConstraint)
            given = own or len(element.acts_on) < DIM
            checks += _compared(label, given, isinstance(element, AbstractConstraint), found)

    def numbers(joint):
        frames = displaced(a, b, starts[0])
        return [
            (
                _said(e, *frames, velocity, time),
                constraint_force(e, *frames, lam, time),
                constraint_stiffness(e, *frames, lam, time),
            )
            for e, lam in zip(elements_of(joint), multipliers)
        ]

    if jax.tree.leaves(joint):
        checks += check_sensitivities(numbers, joint, seed=seed).checks
    return Report(f"{type(joint).__name__}, {poses} poses", worst(checks))


def _said(element: AbstractRows, a, b, velocity, t):
    """Φ, or A v + b at a velocity."""
    if isinstance(element, AbstractConstraint):
        return element.value(a, b, t)
    assert isinstance(element, AbstractVelocityConstraint)
    va, vb = jnp.split(velocity, 2)
    return element.rate(a, b, va, vb, t)


def _program(element: AbstractRows, lam, velocity, t, free, part):
    """What a constraint says, and what follows from its value, at displacements x of two frames."""
    zero = jnp.zeros(DIM, lam.dtype)
    acts = np.isin(np.arange(DIM), element.acts_on)  # what is taken of B
    coupled = np.zeros((DIM, DIM), bool)  # what is added of K
    for places in element.coupled:
        coupled[np.ix_(places, places)] = True

    def jacobian(a, b):
        if isinstance(element, AbstractVelocityConstraint):
            return jax.jacfwd(lambda v: _said(element, a, b, v, t))(velocity)
        return jax.jacfwd(lambda y: _said(element, *displaced(a, b, y), velocity, t))(zero)

    def quantities(x, a, b):
        a, b = displaced(a, b, x)
        force = lambda y: lam @ jacobian(*displaced(a, b, y))
        return {
            "Φ": _said(element, a, b, velocity, t),
            "Φ on a part": _said(carried(element, part, part), a, b, velocity, t)
            - _said(carried(element, part, part, by_frames=True), a, b, velocity, t),
            "B": jnp.where(acts, constraint_jacobian(element, a, b, t), 0.0)[:, free],
            "B by autodiff": jacobian(a, b)[:, free],
            "force": jnp.where(acts, constraint_force(element, a, b, lam, t), 0.0)[free],
            "force by autodiff": force(zero)[free],
            "K": jnp.where(coupled, constraint_stiffness(element, a, b, lam, t), 0.0)[free][:, free],
            "K by autodiff": jax.jacfwd(force)(zero)[free][:, free],
        }

    return jax.jit(jax.vmap(quantities, in_axes=(0, None, None)))


def _compared(label: str, given: bool, of_positions: bool, found) -> Iterator[Check]:
    stiffness = f"{label}K = ∂(Bᵀλ)/∂x"
    yield vanishes(f"{label}Φ", "on a part, in its frame", found["Φ on a part"], float(np.abs(found["Φ"].value).max()))
    if given:
        yield same(f"{label}B", found["B"], found["B by autodiff"])
        yield same(f"{label}Bᵀλ", found["force"], found["force by autodiff"])
    yield same(stiffness, found["K"], found["K by autodiff"])
    if of_positions:
        yield slope(f"{label}B", found["B by autodiff"], found["Φ"])
    yield slope(stiffness, found["K by autodiff"], found["force by autodiff"])


def _reference(joint: AbstractJoint, scene: ScenePoses, a, b, t, free) -> Iterator[Check]:
    """Φ = 0 and full rank of B where the joint was made; moved with the bodies, it is made elsewhere."""

    @jax.jit
    @jax.vmap
    def at(x):
        frames = displaced(a, b, x)
        elements = joint.constraints(*frames)
        still = jnp.zeros(DIM, frames[0].position.dtype)
        return {
            "Φ": jnp.concatenate([_said(element, *frames, still, t) for element in elements]),
            "B": jnp.concatenate([constraint_jacobian(element, *frames, t) for element in elements])[:, free],
        }

    found = scene.sampled(at(scene.points(free)), free)
    if joint.assembled:
        size = max(float(jnp.linalg.norm(frame.position)) for frame in (a, b))
        yield vanishes("Φ", "reference, 0", found["Φ"], max(size, scene.length))
    jacobian = found["B"].value
    lengths = np.linalg.norm(jacobian, axis=1, keepdims=True)
    rank = np.linalg.matrix_rank(jacobian / np.where(lengths > 0, lengths, 1.0), tol=RANK)
    yield Check("rank of B", "reference, equations", float(len(jacobian) - rank), 0.0, f"{rank} of {len(jacobian)}")
