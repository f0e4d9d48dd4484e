"""The scene: bodies, joints and forces by name."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lgsens._brief import listed, roster
from lgsens._validate import array_of, is_concrete
from lgsens.liegroups import nearest_rotation
from lgsens.linear import AbstractLinearSolver, BlockSparse
from lgsens.model._assemble import assemble, assemble_merged
from lgsens.model._beam_sections import BeamSection
from lgsens.model._body import RigidBody
from lgsens.model._checks import check_axes, checked, far_from_rotation, is_inertia, strong
from lgsens.model._evaluate_by_kind import stacked, unstacked
from lgsens.model._flexible import flexible
from lgsens.model._forces import AbstractForce
from lgsens.model._frames import Frame
from lgsens.model._joints import AbstractJoint
from lgsens.model._merge import Group, groups
from lgsens.model._reductions import AbstractReduction, Scene, reduced
from lgsens.model._repeated_rows import Equations, as_redundant, repeated_equations, without
from lgsens.model._se3_system import SE3System
from lgsens.model._summary import Summary, summarize
from lgsens.model._system import MultibodySystem

_FORMULATIONS = ("R3xSO3", "SE3")
_OPTIONS = ("linear_solver", "merge_fixed", "redundant", "formulation")


class Model(eqx.Module):
    """A scene of rigid bodies connected by joints and forces; a pytree whose numbers are all float leaves.

    Arguments:
        bodies: `RigidBody` by name.
        joints: joints by name; each names its two bodies, None for the ground.
        forces: force elements by name.
        linear_solver: how the equations of a step are solved, `DenseLU()` or `BlockSparse()`; None: the one that is
            estimated to take less time for this scene.
        merge_fixed: bodies that a `FixedJoint` connects are one body in the equations of motion, those that it connects
            to the ground are ground: six unknowns per merged body and the joint's equations less.
        redundant: "refuse" raises where joints constrain the same motion twice. "minimum_norm" accepts that, where the
            rank of B does not change: the motion is that of the mechanism without the equations too many,
            `Trajectory.multiplier` the multipliers of least Σ λ_i² (moments divided by the radius of gyration of the
            bodies): the forces in joints that are all equally stiff, in the limit of rigid ones. Derivatives are exact
            for changes that leave the equations redundant (both hinges of a door off their axis, and not one of
            them). "remove" leaves out equations that repeat others, so that everything takes the scene (`statics`,
            `linearize`, `RadauIIA`, `stabilized` too), and names them in `removed`: the motion is the same, joints that
            lost an equation carry nothing in its direction, and derivatives are those of the mechanism that is left,
            for every change. Their choice needs known numbers; where they are traced, give `removed` of a model that
            was built before. `constraint_rank` says which joints are redundant.
        formulation: "R3xSO3", velocities of centres of mass in the inertial frame, or "SE3", in the frame of each body,
            whose steps move it along a screw: another solution of second order, with dense linear algebra. Bodies with
            some of their degrees of freedom are as before. States are in these velocities; what `Trajectory` answers
            by name is the same in both.

    The constructors can be traced, so a function that builds a model from design parameters is the
    general parametrization; the gradient with respect to a model is again a model.

    With `merge_fixed` every body and joint keeps its name, and its numbers as leaves: `Trajectory.body(name)` is the
    motion of a part, `Trajectory.multiplier(name)` of a merged joint is recovered from the equations of motion of its
    parts. The states are those of the merged bodies, another second-order solution of the same equations; that is
    why False is the default. Initial velocities that are not those of one body are projected, as always: momentum and
    angular momentum stay. Bodies with some of their degrees of freedom (`RigidBody.free`) can be merged with whole ones
    and with each other where the result is a `RigidBody`: all of them translate alike, all move in one plane alike, or
    only one turns about a point.

    Raises `ValueError` for a scene without bodies or without degrees of freedom, unknown body names, a joint or
    force between a body and itself, and two joints that are the same connection. With `merge_fixed` also for a joint
    within one merged body, and for bodies whose degrees of freedom cannot be merged.
    """

    bodies: dict[str, RigidBody]
    joints: dict[str, AbstractJoint]
    forces: dict[str, AbstractForce]
    linear_solver: AbstractLinearSolver | None = eqx.field(static=True)
    merge_fixed: bool = eqx.field(static=True)
    redundant: str | Equations = eqx.field(static=True)  # what was removed, of "remove"
    formulation: str = eqx.field(static=True)

    def __init__(
        self,
        bodies: Mapping[str, RigidBody],
        joints: Mapping[str, AbstractJoint] | None = None,
        forces: Mapping[str, AbstractForce] | None = None,
        *,
        linear_solver: AbstractLinearSolver | None = None,
        merge_fixed: bool = False,
        redundant: str | Equations = "refuse",
        formulation: str = "R3xSO3",
    ):
        if not isinstance(linear_solver, AbstractLinearSolver | None):
            raise ValueError(f"Model: `linear_solver` must be DenseLU(), BlockSparse() or None, got {linear_solver!r}.")
        self.linear_solver = linear_solver
        for name, of, kind in (
            ("bodies", bodies, "RigidBody"),
            ("joints", joints, "joint"),
            ("forces", forces, "force"),
        ):
            if not isinstance(of, Mapping | None):
                raise ValueError(f"Model: `{name}` must be a dict, each {kind} by its name, got {type(of).__name__}.")
            for key in of or ():
                if not isinstance(key, str):
                    raise ValueError(f"Model: a name in `{name}` must be a string, got {key!r}; give {str(key)!r}.")
        self.bodies, self.joints, self.forces = (
            {str(name): strong(part) if isinstance(part, eqx.Module) else part for name, part in (of or {}).items()}
            for of in (bodies, joints, forces)
        )
        self.merge_fixed = merge_fixed
        if not isinstance(merge_fixed, bool):
            raise ValueError(f"Model: `merge_fixed` must be True or False, got {merge_fixed!r}.")
        self.redundant = as_redundant(redundant, self.joints)
        self.formulation = formulation
        if formulation not in _FORMULATIONS:
            raise ValueError(f"Model: `formulation` must be one of {_FORMULATIONS}, got {formulation!r}.")
        if formulation == "SE3" and isinstance(linear_solver, BlockSparse):
            raise ValueError(
                "Model: `linear_solver` = BlockSparse() is for formulation='R3xSO3'; leave it out on SE(3)."
            )
        if not self.bodies:
            raise ValueError("Model: `bodies` is empty; a scene needs at least one RigidBody.")
        homes = {"bodies": RigidBody, "joints": AbstractJoint, "forces": AbstractForce}
        for what, kind, members in (
            ("Body", RigidBody, self.bodies),
            ("Joint", AbstractJoint, self.joints),
            ("Force", AbstractForce, self.forces),
        ):
            for name, member in members.items():
                if not isinstance(member, kind):
                    into = next((into for into, of in homes.items() if isinstance(member, of)), None)
                    advice = "" if into is None else f"; put it into `{into}`"
                    raise ValueError(
                        f"{what} {name!r} must be of type {kind.__name__}, got {type(member).__name__}{advice}."
                    )
                if names := [leaf for leaf in jax.tree.leaves(member) if isinstance(leaf, str)]:
                    raise ValueError(
                        f"{what} {name!r}: {type(member).__name__} has names among its numbers, {names}; declare their "
                        "fields with `eqx.field(static=True)`."
                    )
        if not any(body.free for body in self.bodies.values()):
            raise ValueError("Model: no body has a degree of freedom; let at least one of them have a `free` one.")
        for name, joint in self.joints.items():
            _check_connection(f"Joint {name!r}", (joint.a, joint.b), self.bodies)
            _check_connection(f"Joint {name!r}", joint.others, self.bodies)
        for name, force in self.forces.items():
            _check_connection(f"Force {name!r}", force.on(self.joints).bodies, self.bodies)
        self._check_duplicates()
        check_axes(self.bodies, self.joints, self.forces)
        if self._groups is not None and all(group.name is None for group in self._groups):
            raise ValueError("Model: fixed joints hold all bodies on the ground; let at least one of them move.")
        if redundant == "remove":
            self.redundant = repeated_equations(self.system())

    @property
    def removed(self) -> Equations:
        """The equations that are left out: of each its joint, which of the joint's basic constraints, and its row."""
        return () if isinstance(self.redundant, str) else self.redundant

    def __repr__(self) -> str:
        fields = {name: roster(getattr(self, name)) for name in ("bodies", "joints", "forces")}
        options = {name: getattr(self, name) for name in _OPTIONS}
        return listed("Model", fields | {name: repr(value) for name, value in options.items()})

    def _check_duplicates(self) -> None:
        alike: dict[Any, list[str]] = {}
        for name, joint in self.joints.items():
            alike.setdefault((type(joint), frozenset((joint.a, joint.b))), []).append(name)
        for names in alike.values():
            for first, second in combinations(names, 2):
                one, other = self.joints[first], self.joints[second]
                if is_concrete(one, other) and _is_same_connection(one, other):
                    raise ValueError(
                        f"Joints {first!r} and {second!r} are the same {type(one).__name__} between "
                        f"{one.a!r} and {one.b!r} at the same place; remove one of them."
                    )

    def equations(self) -> MultibodySystem | SE3System:
        """The equations of motion in the formulation of the model: what is integrated. Raises as `system`."""
        system = self.system()
        return SE3System(bodies=system, assembled=system.assembled) if self.formulation == "SE3" else system

    def system(self) -> MultibodySystem:
        """The equations of motion on R³ × SO(3), elements stacked by type.

        Raises `ValueError` for numbers that have come in since construction and that no scene has, if they are known.
        """
        names, self = sorted(self.bodies), self._checked()
        # An optimizer that updates a whole model leaves SO(3) by the square of its step.
        orientations = lambda bodies: [bodies[name].orientation for name in names]
        found = orientations(self.bodies)
        rotations = nearest_rotation(np.stack(found) if is_concrete(found) else stacked(found))
        bodies = eqx.tree_at(orientations, dict(self.bodies), unstacked(rotations))
        frames = Frame(stacked([bodies[name].frame.position for name in names]), array_of(rotations))
        if self._groups is None:
            system = assemble(bodies, frames, self.joints, self.forces)
        else:
            system = assemble_merged(bodies, frames, self.joints, self.forces, self._groups)
        if system.reads_multipliers and self.redundant == "minimum_norm":
            raise ValueError(
                "Model: friction from the forces of a joint needs multipliers that are unique, and redundant="
                "'minimum_norm' does not have them; remove the redundant equations, or take own_forces=False."
            )
        return dataclasses.replace(
            without(system, self.removed),
            linear_solver=self.linear_solver,
            minimum_norm=self.redundant == "minimum_norm",
        )

    def _checked(self) -> "Model":
        """The same model with checked numbers."""
        members = [
            {name: checked(f"{what} {name!r}", member) for name, member in of.items()}
            for what, of in (("Body", self.bodies), ("Joint", self.joints), ("Force", self.forces))
        ]
        _check_bodies(members[0])
        return jax.tree.unflatten(jax.tree.structure(self), jax.tree.leaves(members))  # numbers alone have changed

    @property
    def _groups(self) -> tuple[Group, ...] | None:
        """What fixed joints make of the bodies; None where each of them stays a body of its own."""
        if not self.merge_fixed:
            return None
        found = groups(self.bodies, self.joints)
        return None if all(group.name in self.bodies for group in found) else found

    def reduced(self, *reductions: AbstractReduction) -> "Model":
        """A leaner model: without what does not matter.

        ```python
        lean = model.reduced(lg.model.Rod("trailing_arm"), lg.model.Without("bump_stop"))
        ```

        Arguments:
            reductions: `Rod`, `Joint`, `Merged`, `Fixed`, `Frozen`, `Without` and, of beams, `Rigid` of `lgsens.model`,
                applied in turn.

        Numbers of the lean model are functions of those of this one and derivatives go through.
        `lgsens.accuracy.fidelity` says what each of them changes. Raises `ValueError` as these do and as `Model`.
        """
        return self._of(reduced(self._scene, reductions))

    def flexible(
        self,
        links: Mapping[str, BeamSection],
        *,
        elements: int = 4,
        up=(0.0, 0.0, 1.0),
        nodes: Mapping[str, int] | None = None,
    ) -> "Model":
        """A richer model: links that two joints hold bend, each a `Beam` of its name between the points of both.

        ```python
        steel = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}
        model = model.flexible({"trailing_arm": lg.BeamSection.tube(0.04, 0.003, **steel)})
        ```

        Arguments:
            links: the section of each link, by the names of bodies. Mass and inertia are now those of the beam.
            elements: of each, static.
            up: as in `Beam`.
            nodes: numbers of the nodes that carry joints and forces, by their names. The two joints that are not named
                hold node 0, the first of them by name, and the last one; a force holds the nearest node, which is
                known only where points are.

        The bodies are then "trailing_arm.0" … "trailing_arm.4". Preloads are as before, so that the scene is not at
        rest: `static_preload` also of its beam elements, or `equilibrium`. `lgsens.accuracy.fidelity` with
        `lgsens.model.Rigid("trailing_arm")` says what bending changes. Raises `ValueError` for unknown names, links
        that other than two joints hold, and what `Beam` refuses.
        """
        return self._of(flexible(self._scene, links, elements, up, nodes or {}))

    @property
    def _scene(self) -> Scene:
        return Scene(self.bodies, self.joints, self.forces, self.merge_fixed)

    def _of(self, scene: Scene) -> "Model":
        options: dict[str, Any] = {name: getattr(self, name) for name in _OPTIONS} | {"merge_fixed": scene.merge_fixed}
        kinds = lambda joints: {name: (type(joint), joint.a, joint.b) for name, joint in joints.items()}
        if not isinstance(self.redundant, str) and kinds(scene.joints) != kinds(self.joints):
            options["redundant"] = "remove"  # anew, of known numbers
        return Model(*scene[:3], **options)

    def toward(self, paths: Sequence[Sequence[AbstractReduction]], s, rate) -> "Model":
        """The scene of this structure at s on the way to some reductions (`_reductions.py`); `rate`: [1/s]."""
        scene = self._scene
        for path, place in zip(paths, s):
            scene = path[-1].toward(scene, reduced(self._scene, path[:-1]), place, rate)
        return self._of(scene)

    def summary(self) -> Summary:
        """Bodies with their free coordinates, joints with their equations, force elements, and the totals.

        `print(model.summary())` shows a table: unknown coordinates, constraint equations, and their difference,
        the degrees of freedom of a mechanism without redundant equations.
        """
        system = eqx.filter_eval_shape(Model.system, self)
        return summarize(self.bodies, self.joints, self.forces, system, self._groups or ())


# Not a method: at each call of one Equinox goes through all leaves of the model.
def _check_connection(what: str, ends: tuple[str | None, ...], bodies: Mapping[str, RigidBody]) -> None:
    for end in ends:
        if end is not None and end not in bodies:
            raise ValueError(f"{what} refers to body {end!r}; the bodies are {sorted(bodies)}, and None is the ground.")
    if len(ends) == 2 and ends[0] == ends[1]:
        where = "the ground" if ends[0] is None else f"body {ends[0]!r}"
        raise ValueError(f"{what} connects {where} to itself; name two different bodies.")


def _check_bodies(bodies: Mapping[str, RigidBody]) -> None:
    """All of them at once: a hundred are checked in the time of three."""

    def first_wrong(field: str, right: Callable) -> str | None:
        """The first body whose known matrix of a field is not right."""
        given = {name: getattr(body, field) for name, body in bodies.items()}
        known = {name: np.asarray(value) for name, value in given.items() if value is not None and is_concrete(value)}
        matrices = [np.diag(value) if value.ndim == 1 else value for value in known.values()]
        found = right(np.stack(matrices)) if matrices else []
        return next((name for name, is_right in zip(known, found) if not is_right), None)

    if name := first_wrong("inertia", is_inertia):
        raise ValueError(
            f"Body {name!r}: `inertia` {bodies[name].inertia} is not that of a body: a principal moment is negative, "
            "or larger than the sum of the others; bound what an optimizer may change."
        )
    if name := first_wrong("orientation", lambda orientation: ~far_from_rotation(orientation)):
        raise ValueError(
            f"Body {name!r}: `orientation` {bodies[name].orientation} is far from a rotation; leave it to the model "
            "(`equinox.partition`), or take smaller steps."
        )


def _is_same_connection(one: AbstractJoint, other: AbstractJoint) -> bool:
    """Whether two joints of one type between the same two bodies, in either order, have the same numbers."""
    numbers, others = _numbers(one, exchanged=False), _numbers(other, exchanged=one.a != other.a)
    same_structure = jax.tree.structure(numbers) == jax.tree.structure(others)
    return same_structure and jax.tree.all(jax.tree.map(np.array_equal, numbers, others))


def _numbers(joint: AbstractJoint, *, exchanged: bool) -> dict[str, Any]:
    """The numbers of a joint by field; `exchanged`: those of its end a (`at_a`) under the name for b."""
    swap = {"_a": "_b", "_b": "_a"} if exchanged else {}
    names = [field.name for field in dataclasses.fields(joint) if field.name not in ("a", "b")]
    return {name[:-2] + swap.get(name[-2:], name[-2:]): getattr(joint, name) for name in names}
