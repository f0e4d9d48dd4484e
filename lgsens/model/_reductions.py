"""Leaner scenes out of richer ones, and the path of scenes between both.

A reduction is a value that names what it leaves out. `applied` makes the lean scene. `toward` makes a scene of the
*rich* structure that depends on a number s: at s = 0 it is the rich one, and as s → 1 its motion becomes that of the
lean one, so that derivatives by s tell what the reduction does (`lgsens.accuracy.fidelity`):

    beam → rigid         its forces K ε as K ε/(1 − s): at 1 it does not bend (`_flexible.py`)
    link → rod           its mass and inertia times 1 − s, the shares of its ends times s: at 1 a massless link
    bushing → joint      its force g = g₀ + K u + C u̇ + … as g₀ + (g − g₀)/(1 − s): at 1 it does not yield
    force left out       the force, or some of its numbers, times 1 − s
    body held            a spring s K and a damper s D on the coordinates that are held, far faster than the motion

Along the first four s is a small parameter of a rich scene that is nearly lean. The last has no such parameter: what a
coordinate does that is free says nothing of what happens when it is held; K at s = 1 is the virtual compliance 1/K.
"""

import abc
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from lgsens._validate import suggestion
from lgsens.model._body import RigidBody
from lgsens.model._bushing import Bushing
from lgsens.model._forces import AbstractForce
from lgsens.model._free import ALL_FREE, TRANSLATIONS, as_free
from lgsens.model._joints import AbstractJoint, DistanceJoint, FixedJoint
from lgsens.model._relative import ARM_ANGLES, ROTATION_VECTOR
from lgsens.model._scaled import ScaledForce

_BALLS = (ROTATION_VECTOR, ARM_ANGLES)  # what joints leave free that hold a link at their point, and no more but spin


class Scene(NamedTuple):
    """What a model is made of."""

    bodies: Mapping[str, RigidBody]
    joints: Mapping[str, AbstractJoint]
    forces: Mapping[str, AbstractForce]
    merge_fixed: bool

    def replaced(self, **members: Mapping[str, Any]) -> "Scene":
        """With members of these kinds added or replaced; None: without them."""
        new = {kind: {**getattr(self, kind), **of} for kind, of in members.items()}
        kept = {kind: {name: member for name, member in of.items() if member is not None} for kind, of in new.items()}
        return self._replace(**kept)


class AbstractReduction(eqx.Module):
    """What is left out of a scene; a value of names. `holds`: it holds coordinates that the scene has."""

    holds: ClassVar[bool]

    @abc.abstractmethod
    def applied(self, scene: Scene) -> Scene:
        """The lean scene. Raises `ValueError` where this one has no such members."""

    @abc.abstractmethod
    def toward(self, scene: Scene, before: Scene, s, rate) -> Scene:
        """The scene at s on the way.

        Arguments:
            scene: the rich one, on its way by others too. before: the one to which the reduction is applied.
            s: 0 … 1. rate: how fast what is held follows [1/s].
        """


class Rod(AbstractReduction):
    """A link that two ball or universal joints hold becomes a massless rod, a `DistanceJoint` of its name.

    Arguments:
        link: name of the body.
        lump: whether its mass goes to its ends, in the shares that keep its centre of mass along the rod, on the bodies
            there, whose centres of mass and inertias move with it. False: it is left out.

    Its inertia about its own axis and its spin are left out. Raises `ValueError`, when it is applied, for a body that
    other joints hold, on which a force acts, or whose centre of mass is not between its ends.
    """

    link: str = eqx.field(static=True)
    lump: bool = eqx.field(static=True, default=True)

    holds = False

    def _ends(self, scene: Scene) -> list[tuple[str, str | None, Any]]:
        """The joint, the other body and the point of each end."""
        _known(self, "link", self.link, scene.bodies)
        near: dict[str, Any] = {name: j for name, j in scene.joints.items() if self.link in (j.a, j.b, *j.others)}
        loaded = [name for name, force in scene.forces.items() if self.link in force.on(scene.joints).bodies]
        if len(near) != 2 or not all(joint.coordinates in _BALLS for joint in near.values()) or loaded:
            kinds = {name: type(joint).__name__ for name, joint in near.items()}
            raise ValueError(
                f"{self!r}: a rod takes the place of a body that two spherical or universal joints hold and on which "
                f"nothing acts; {self.link!r} has {kinds} and the forces {loaded}. Leave it a body, or reduce those "
                "first (`Joint`, `Without`)."
            )
        return [(name, joint.b if joint.a == self.link else joint.a, joint.at) for name, joint in near.items()]

    def _lumped(self, scene: Scene, before: Scene, s) -> dict[str, RigidBody]:
        (_, a, start), (_, b, end) = self._ends(before)
        link = before.bodies[self.link]
        along = (end - start) / jnp.sum((end - start) ** 2)
        share = jnp.dot(link.position - start, along)
        bodies: dict[str, RigidBody] = {}
        for body, part, place in ((a, 1.0 - share, start), (b, share, end)):
            if self.lump and body is not None:
                bodies[body] = scene.bodies[body].with_points([s * part * link.mass], [place])
        return bodies

    def applied(self, scene):
        (first, a, start), (second, b, end) = self._ends(scene)
        lumped = self._lumped(scene, scene, 1.0)
        without = {first: None, second: None}
        if self.link in {*scene.joints} - {*without}:
            raise ValueError(f"{self!r}: a joint is called {self.link!r} already; give the body another name.")
        rod = DistanceJoint(a, b, at_a=start, at_b=end)
        return scene.replaced(bodies=lumped | {self.link: None}, joints=without | {self.link: rod})

    def toward(self, scene, before, s, rate):
        link = scene.bodies[self.link]
        where = lambda body: (body.mass, *(() if body.inertia is None else (body.inertia,)))
        lighter = eqx.tree_at(where, link, tuple((1.0 - s) * number for number in where(link)))
        return scene.replaced(bodies=self._lumped(scene, before, s) | {self.link: lighter})


class Without(AbstractReduction):
    """A force element is left out, or some of its numbers are zero.

    Arguments:
        force: its name.
        numbers: names of numbers of it, "damping" for example; none: all of it.

    Raises `ValueError`, when it is applied, for names that the scene or the element does not have.
    """

    force: str = eqx.field(static=True)
    numbers: tuple[str, ...] = eqx.field(static=True)

    holds = False

    def __init__(self, force: str, *numbers: str):
        self.force, self.numbers = force, numbers

    def _scaled(self, scene: Scene, factor) -> AbstractForce:
        """It with its `numbers` times a factor."""
        force: Any = scene.forces[self.force]
        known = [field.name for field in dataclasses.fields(force) if eqx.is_array(getattr(force, field.name))]
        for number in self.numbers:
            if number not in known:
                raise ValueError(f"{self!r}: {suggestion(number, known)}, the numbers of this {type(force).__name__}.")
        return dataclasses.replace(force, **{number: factor * getattr(force, number) for number in self.numbers})

    def applied(self, scene):
        _known(self, "force", self.force, scene.forces)
        return scene.replaced(forces={self.force: self._scaled(scene, 0.0) if self.numbers else None})

    def toward(self, scene, before, s, rate):
        _known(self, "force", self.force, scene.forces)
        if not self.numbers:
            return scene.replaced(forces={self.force: ScaledForce(scene.forces[self.force], factor=1.0 - s)})
        lean, rich = self._scaled(before, 0.0), before.forces[self.force]  # others may be on their way with it
        both = {f"{self!r}, lean": ScaledForce(lean, factor=s), f"{self!r}, rich": ScaledForce(rich, factor=-s)}
        return scene.replaced(forces=both)


class Joint(AbstractReduction):
    """A `Bushing`, or an element of a `Beam`, becomes the joint that it is nearly, of its name.

    Arguments:
        bushing: name of the force element.
        kind: "spherical", "revolute" (about the axis of least rate) or "fixed"; None: by its rates, spherical if it
            resists no rotation, or one about less than two axes, revolute if one rate is below a hundredth of the
            largest, else fixed. An element of a beam becomes a fixed joint (`Rigid`: all of them).

    What it resists in directions that the joint leaves free is left out. Raises `ValueError`, when it is applied, for
    elements that are no bushings, and for rates that are not known (traced) and would choose: give `kind`.
    """

    bushing: str = eqx.field(static=True)
    kind: str | None = eqx.field(static=True, default=None)

    holds = False

    def _split(self, scene: Scene):
        _known(self, "bushing", self.bushing, scene.forces)
        return scene.forces[self.bushing].as_joint(self.kind, repr(self))

    def applied(self, scene):
        joint = self._split(scene)[0]
        if self.bushing in scene.joints:
            raise ValueError(f"{self!r}: a joint is called {self.bushing!r} already; give the force another name.")
        return scene.replaced(forces={self.bushing: None}, joints={self.bushing: joint})

    def toward(self, scene, before, s, rate):
        _, blocked, left = self._split(before)
        parts = {f"{self.bushing}: stiffer": ScaledForce(blocked, factor=s / (1.0 - s))}
        if left is not None:
            parts[f"{self.bushing}: softer"] = ScaledForce(left, factor=-s)
        return scene.replaced(forces=parts)


class Merged(AbstractReduction):
    """Two bodies become one: a `FixedJoint` in place of the joints between them, and `Model(merge_fixed=True)`.

    Arguments:
        a, b: names of the two bodies, which keep them.

    Forces between both stay where they act otherwise than between two parts of a body. Raises `ValueError`, when it is
    applied, for names that the scene does not have.
    """

    a: str = eqx.field(static=True)
    b: str = eqx.field(static=True)

    holds = True

    def applied(self, scene):
        for name, body in (("a", self.a), ("b", self.b)):
            _known(self, name, body, scene.bodies)
        between = [name for name, joint in scene.joints.items() if {joint.a, joint.b} == {self.a, self.b}]
        name = between[0] if between else f"{self.a} + {self.b}, fixed"
        fixed = FixedJoint(self.a, self.b, at=scene.bodies[self.b].position)
        return scene.replaced(joints=dict.fromkeys(between) | {name: fixed})._replace(merge_fixed=True)

    def toward(self, scene, before, s, rate):
        both = [scene.bodies[self.a], scene.bodies[self.b]]
        return _held(self, scene, self.a, self.b, both, s, rate, ALL_FREE)


class Frozen(AbstractReduction):
    """A body without some of its degrees of freedom: those coordinates keep their values, `RigidBody.free`.

    Arguments:
        body: its name.
        coordinates: names among "x", "y", "z", "rx", "ry", "rz", in a tuple or one string; none: all that it has.
        guide: the joint that holds them already (a `PrismaticJoint` along z, say, where only z is left), to be left out
            with them; None: no joint is left out but for equations that nothing can violate.

    Their initial velocities are left out. Raises `ValueError`, when it is applied, for names that the scene or the body
    does not have, and where `RigidBody` does not have what is left (one rotation is about an inertial axis).
    """

    body: str = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    guide: str | None = eqx.field(static=True)

    holds = True

    def __init__(self, body: str, coordinates: str | Iterable[str] = (), *, guide: str | None = None):
        names = tuple(coordinates.split()) if isinstance(coordinates, str) else tuple(coordinates)
        unknown = set(names) - set(ALL_FREE)
        if unknown:
            raise ValueError(f"Frozen: {suggestion(sorted(unknown)[0], ALL_FREE)}.")
        self.body, self.coordinates, self.guide = body, names, guide

    def applied(self, scene):
        _known(self, "body", self.body, scene.bodies)
        body = scene.bodies[self.body]
        frozen = self.coordinates or body.free
        if missing := set(frozen) - set(body.free):
            raise ValueError(f"{self!r}: body {self.body!r} has {body.free!r} and not {sorted(missing)}.")
        free = tuple(name for name in body.free if name not in frozen)
        moves = jnp.asarray([name in free for name in ALL_FREE], body.mass.dtype)
        try:
            held = dataclasses.replace(
                body,
                free=as_free(free, "`free`"),
                velocity=moves[:3] * body.velocity,
                angular_velocity=moves[3:] * body.angular_velocity,
                pivot=body.pivot if free else None,
            )
        except ValueError as error:
            raise ValueError(f"{self!r}: {error}") from error
        if self.guide is None:
            return scene.replaced(bodies={self.body: held})
        _known(self, "guide", self.guide, scene.joints)
        return scene.replaced(bodies={self.body: held}, joints={self.guide: None})

    def toward(self, scene, before, s, rate):
        _known(self, "body", self.body, scene.bodies)
        body = scene.bodies[self.body]
        return _held(self, scene, None, self.body, [body], s, rate, self.coordinates or body.free)


def Fixed(body: str) -> Frozen:
    """A body is held where it is: `Frozen` in all degrees of freedom that it has.

    Arguments:
        body: its name.
    """
    return Frozen(body)


def _held(self, scene: Scene, a, b, bodies, s, rate, names) -> Scene:
    """With s K and s D on coordinates: K = m ω², D = 2 m ω by the smaller mass, and by the least radius of gyration."""
    mass = jnp.min(jnp.stack([body.mass for body in bodies]))
    turning = [jnp.min(jnp.diag(body.inertia_matrix)) for body in bodies if body.inertia is not None]
    inertia = jnp.min(jnp.stack(turning)) if turning else mass
    on = jnp.asarray([name in names for name in ALL_FREE], mass.dtype) * s
    moves, turns = on[:3] * mass * rate, on[3:] * inertia * rate
    rates: dict[str, Any] = {"stiffness": moves * rate, "damping": 2.0 * moves}
    if {*names} - {*TRANSLATIONS}:
        rates |= {"rotational_stiffness": turns * rate, "rotational_damping": 2.0 * turns}
    return scene.replaced(forces={f"{self!r}": Bushing(a, b, at=bodies[-1].frame.position, **rates)})


def _known(self, what: str, name: str, members: Mapping[str, Any]) -> None:
    if name not in members:
        raise ValueError(f"{self!r}: `{what}`: {suggestion(name, members)}.")


def reduced(scene: Scene, reductions: Iterable[Any]) -> Scene:
    """The scene after some reductions, one after the other."""
    for reduction in reductions:
        if not isinstance(reduction, AbstractReduction):
            raise ValueError(
                "Model.reduced: reductions must be Rod, Without, Joint, Merged, Frozen, Fixed or Rigid, got "
                f"{reduction!r}."
            )
        scene = reduction.applied(scene)
    return scene
