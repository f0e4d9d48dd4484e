"""Links that bend, in place of rigid ones, and back."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import is_concrete, suggestion
from lgsens.liegroups import cross
from lgsens.model._beam_sections import BeamSection
from lgsens.model._beams import Beam
from lgsens.model._body import RigidBody
from lgsens.model._reductions import AbstractReduction, Joint, Scene, reduced


class Rigid(AbstractReduction):
    """A `Beam` becomes one rigid body: its elements fixed joints of their names, and `Model(merge_fixed=True)`.

    Arguments:
        beam: its name.

    Its nodes stay bodies, by their names, with their masses and inertias. On the way to it the beam is stiffer by
    1/(1 − s). Raises `ValueError`, when it is applied, for a name that no beam of the scene has.
    """

    beam: str = eqx.field(static=True)

    holds = False

    def _joints(self, scene: Scene) -> list[Joint]:
        """The reductions of its elements."""
        beams: dict[str, list[Joint]] = {}
        for name in scene.forces:
            beams.setdefault(name.rpartition(".")[0], []).append(Joint(name, "fixed"))
        if self.beam not in beams:
            raise ValueError(f"{self!r}: `beam`: {suggestion(self.beam, {*beams} - {''})}.")
        return beams[self.beam]

    def applied(self, scene):
        return reduced(scene, self._joints(scene))._replace(merge_fixed=True)

    def toward(self, scene, before, s, rate):
        for joint in self._joints(before):
            scene = joint.toward(scene, before, s, rate)
        return scene


def flexible(scene: Scene, links: Mapping[str, BeamSection], elements: int, up, nodes: Mapping[str, int]) -> Scene:
    """See `Model.flexible`."""
    known = {*scene.joints, *scene.forces}
    if unknown := sorted({*nodes} - known):
        raise ValueError(f"Model.flexible: `nodes`: {suggestion(unknown[0], known)}.")
    for link, section in links.items():
        if link not in scene.bodies:
            raise ValueError(f"Model.flexible: `links`: {suggestion(link, scene.bodies)}.")
        joints = {
            name: joint for name, joint in sorted(scene.joints.items()) if link in (joint.a, joint.b, *joint.others)
        }
        ends = [name for name in joints if name not in nodes]
        if len(ends) != 2:
            raise ValueError(
                f"Model.flexible: a beam takes the place of a link between the points of two joints; {link!r} has "
                f"{sorted(joints)}. Name with `nodes` what else holds on to it, or make a `Beam` and connect that."
            )
        beam = Beam(link, section, [_point(name, joints[name], link) for name in ends], elements=elements, up=up)
        number = dict(zip(ends, (0, elements))) | dict(nodes)
        forces = {name: force for name, force in scene.forces.items() if link in force.bodies}
        for name, force in forces.items():
            if name not in number:
                number[name] = _nearest(name, beam, _point(name, force, link))
        on_node = {name: _renamed(name, of, link, beam, number[name]) for name, of in (joints | forces).items()}
        scene = scene.replaced(
            bodies={link: None} | _moving(beam, scene.bodies[link]),
            joints={name: on_node[name] for name in joints},
            forces={name: on_node[name] for name in forces} | beam.forces,
        )
    return scene


_ENDS = ("a", "b", "body")


def _side(name: str, member: Any, link: str) -> str:
    """The field of a joint or a force that says that it holds on to this body."""
    side = next((field for field in _ENDS if getattr(member, field, None) == link), None)
    if side is None:
        raise ValueError(
            f"Model.flexible: {name!r}, a {type(member).__name__}, depends on {link!r} and has no end there; leave "
            f"{link!r} rigid, or make a `Beam` and connect it."
        )
    return side


def _point(name: str, member: Any, link: str) -> Float[Array, "3"]:
    """Where it holds on to it."""
    point = getattr(member, f"at_{_side(name, member, link)}", getattr(member, "at", None))
    if point is None:
        raise ValueError(
            f"Model.flexible: {name!r}, a {type(member).__name__}, holds on to {link!r} and has no point there; give "
            "the number of its node with `nodes`."
        )
    return point


def _renamed(name: str, member: Any, link: str, beam: Beam, node: int):
    if not 0 <= node < len(beam.nodes):
        raise ValueError(f"Model.flexible: `nodes`: {name!r} must be at 0 to {len(beam.nodes) - 1}, got {node}.")
    return dataclasses.replace(member, **{_side(name, member, link): beam.nodes[node]})


def _nearest(name: str, beam: Beam, point: Float[Array, "3"]) -> int:
    if not is_concrete(beam.points, point):
        raise ValueError(
            f"Model.flexible: the node of {beam.name!r} that carries {name!r} follows from points that are not known "
            f"here; give its number, 0 to {len(beam.nodes) - 1}, with `nodes`."
        )
    return int(np.argmin(np.linalg.norm(np.asarray(beam.points) - np.asarray(point), axis=1)))


def _moving(beam: Beam, link: RigidBody) -> dict[str, RigidBody]:
    """The nodes with the velocities that they have on the rigid link."""
    spin = link.orientation @ link.angular_velocity
    return {
        name: dataclasses.replace(
            body,
            velocity=link.velocity + cross(spin, body.position - link.position),
            angular_velocity=body.orientation.T @ spin,
        )
        for name, body in beam.bodies.items()
    }
