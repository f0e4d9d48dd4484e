"""An axle: two corners, and what is between them."""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float
from lgsens.examples._axle_file import axle_members
from lgsens.examples._axle_parts import Bar, Rack
from lgsens.examples._bending import with_nodes
from lgsens.examples._corner_check import check_corner
from lgsens.examples._corner_scene import CornerScene, corner_scene
from lgsens.examples._hardpoint_file import read
from lgsens.examples._quarter_car import GRAVITY, QuarterCar, check_choice
from lgsens.examples._solid_axle import BODY, SolidAxle
from lgsens.examples._suspension_file import reader
from lgsens.examples._suspension_parts import Part, numbered, reflected, regrouped
from lgsens.examples._twist_beam import TwistBeam
from lgsens.examples._wheel import Stance
from lgsens.model import (
    ALL_FREE,
    BumpRoad,
    FixedJoint,
    FlatRoad,
    Gravity,
    Model,
    PrismaticJoint,
    TranslationDriver,
    TyreSpring,
    static_preload,
)

LEAST_TRACK = 0.4  # m


class Axle(eqx.Module):
    """Two corners of a suspension, with subframe, rack and anti-roll bar between them. `Axle.load()` reads it.

    The corner on the right is the mirror image of that on the left, so a gradient by a number of `left` is by that of
    both sides; with corners of two sides, `two_sided`, each has its own. All numbers are leaves. Frame: x forward, y
    left, z up over the road; SI units.

    Attributes:
        left: the corner on the left, a `QuarterCar`, with the bushings and stops of its side.
        other: the corner on the right; None: `left.mirrored()`.
        subframe: a body that carries links in place of the chassis, on mounts of the corners; None: there is none.
        rack: it slides and steers; None: the wheels are not steered.
        bar: the anti-roll bar, the same on both sides; None: there is none.
        twist_beam: the cross member of a twist-beam axle, the same on both sides; None: there is none.
        vehicle: of the car wheelbase, centre_height [m], braking_share, traction_share [–], as far as the file says,
            shape (), for the rig (`rigs.vehicle_of`). rear: whether this is its rear axle (static).
        solid_axle: what holds an axle whose knuckles are one body, beside the links of its corners; None: they are two.
    """

    left: QuarterCar
    other: QuarterCar | None = None
    subframe: Part | None = None
    rack: Rack | None = None
    bar: Bar | None = None
    twist_beam: TwistBeam | None = None
    solid_axle: SolidAxle | None = None
    vehicle: dict[str, Float[Array, ""]] = eqx.field(default_factory=dict)
    rear: bool = eqx.field(static=True, default=True)

    @staticmethod
    def load(path: str | Path | None = None) -> "Axle":
        """Read an axle from the file of a suspension: its corner, the mirror image, and the tables of an axle.

        Arguments:
            path: as of `QuarterCar.load`; the corner of the file is on either side.

        Raises `ValueError` naming the file and the key as `QuarterCar.load`.
        """
        with jax.ensure_compile_time_eval():
            corner, name = QuarterCar._read(path)
            root, kilogram = reader(*read(path))
            if not abs(float(corner.wheel.centre[1])) > LEAST_TRACK / 2:
                raise root.table("wheel").fail(
                    "centre",
                    f"is {float(corner.wheel.centre[1]):.4g} m from the middle of the car, y = 0, and the other wheel "
                    f"of an axle is its mirror image there; no car has a track of less than {LEAST_TRACK} m.",
                )
            between = axle_members(root, kilogram, corner)
            if BODY not in root:
                check_corner(corner, f"Hardpoint file {name!r}", between.get("bar"))
            left, solid = between.pop("left"), between.get("solid_axle")
            axle = Axle(with_nodes(left, between["bar"].ends) if "bar" in between else left, **between)
            if solid is not None:
                solid.check(f"Hardpoint file {name!r}", {"left": axle.left, "right": axle.right}, compliant=True)
            if corner.wheel.centre[1] > 0:
                return axle
            # Links that there are once are where the file has them.
            return dataclasses.replace(reflected(axle), left=axle.left.mirrored(), solid_axle=solid)

    @property
    def name(self) -> str:
        """That of its corner."""
        return self.left.name

    @property
    def right(self) -> QuarterCar:
        """The corner on the right."""
        return self.left.mirrored() if self.other is None else self.other

    @property
    def wheel_centres(self) -> dict[str, Float[Array, "3"]]:
        """By side the wheel centre at the design position [m], shape (3,)."""
        return {"left": self.left.wheel.centre, "right": self.right.wheel.centre}

    def _own_chassis(self) -> dict[str, Array]:
        """By link of a solid axle the points at which it holds on to the chassis."""
        links = {} if self.solid_axle is None else self.solid_axle.links
        return {name: link.chassis for name, link in sorted(links.items()) if "chassis" in link.ends}

    @property
    def hardpoints(self) -> Float[Array, "n 3"]:
        """Where the links and joints of the left side, and of a solid axle, hold on to the chassis [m], (n, 3)."""
        own = [jnp.atleast_2d(points) for points in self._own_chassis().values()]
        return jnp.concatenate([self.left.hardpoints, *own] if self.left.hardpoint_names else own)

    @property
    def hardpoint_names(self) -> list[str]:
        """Theirs, as of `QuarterCar.hardpoint_names`."""
        return self.left.hardpoint_names + numbered(self._own_chassis())

    @property
    def hardpoint_signs(self) -> np.ndarray:
        """What derivatives by them are multiplied by to be in the axes of the file, shape (n, 3)."""
        signs = np.ones((len(self.hardpoint_names), 3))
        signs[: len(self.left.hardpoint_names)] = self.left.axes.signs
        return signs

    def with_hardpoints(self, points: Float[Array, "n 3"]) -> "Axle":
        """The axle with others [m], those of the left side mirrored. Raises `ValueError` for another shape."""
        points = as_float(points, (len(self.hardpoint_names), 3), "`points`")
        count = len(self.left.hardpoint_names)
        left = self.left.with_values(hardpoints=points[:count]) if count else self.left
        own, rest = self._own_chassis(), points[count:]
        if not own:
            return dataclasses.replace(self, left=left)
        where = lambda axle: [axle.left, *axle._own_chassis().values()]
        return eqx.tree_at(where, self, [left, *regrouped(rest, list(own.values()))])

    @property
    def mass(self) -> Float[Array, ""]:
        """Of all bodies [kg]: of two quarters of a car, and what is between them."""
        between = [self.subframe, None if self.rack is None else self.rack.part]
        every = [part.mass for part in (self.left, self.right, *between) if part is not None]
        every += [part.own_mass for part in self._spanning]
        return jnp.sum(jnp.stack(every))

    @property
    def _spanning(self) -> list[Any]:
        """What goes from one corner to the other."""
        return [part for part in (self.bar, self.twist_beam, self.solid_axle) if part is not None]

    def two_sided(self) -> "Axle":
        """The same axle with numbers of its own on each side."""
        return dataclasses.replace(self, other=self.right)

    def model(
        self, *, chassis: str = "held", links: str = "bodies", compliant: bool = True, tyres: bool = False
    ) -> Model:
        """The scene at the design position, in which it rests under the loads of its wheels.

        Bodies are `chassis`, `subframe`, `rack`, and of each side `left_knuckle`, `left_wheel`, which is locked to it,
        `left_anti_roll_bar`, and `left_LINK` of every link. Joints are `left_hub`, `left_LINK_BODY`, those of the file
        (`left_NAME`), `left_drop_link`, and `steering`, which holds the rack at its design position; forces `gravity`,
        `left_spring`, `left_damper`, `left_NAME` of bushings (of a hinge `left_NAME_1` and `_2`), `left_subframe_NAME`,
        `left_bump_stop`, `anti_roll_bar`, `left_tyre`. Of beams there are nodes and elements in their places,
        `left_LINK.0`, `anti_roll_bar.0`, …, the first on the left, and `left_anti_roll_bar_BODY`, what carries the bar.
        A twist beam has `twist_beam.0`, … and the joints `left_twist_beam_BODY`; or `left_twist_beam`, rigid, and the
        joint and the force `twist_beam`. The knuckles of a solid axle are fixed to each other by the joint `live_axle`,
        or `solid_axle` of one whose final drive is on the chassis; links that it has once are LINK, with joints
        `LINK_BODY`.

        Arguments:
            chassis: "held", or "guided": it heaves, and rolls about its centre of mass.
            links: "bodies", or "rods" as in `QuarterCar.model`; a link with a bushing remains a body.
            compliant: whether there are bushings and beams. False: each is the joint that it replaces, the subframe is
                fixed to the chassis, no link bends, and a bar or a twist beam has halves and the stiffness of its beam
                in torsion (`Bar`, `TwistBeam`).
            tyres: whether the wheels stand on a road, on `TyreSpring`s over their contact centres.

        The preloads of springs, tyres, bushings and beams are those with which the whole car, guided and on tyres,
        rests: of those that do, they are of least energy (`static_preload`). Bushings with preloads of their own then
        take these, and where they are others, the car rests elsewhere. Raises `ValueError` for an unknown kind of
        chassis or links, and as `QuarterCar.model`.
        """
        check_choice("chassis", chassis, ("held", "guided"))
        shared, joints = self._between(compliant)
        cars = {"left": self.left, "right": self.right}
        scene = self._sides(cars, joints, links, compliant, FlatRoad())
        bodies = scene.bodies | {
            name: part.body(scene.ends.get(name, ())) for name, part in shared.items() if name != "chassis"
        }
        frame = lambda free: {"chassis": shared["chassis"].body(scene.ends.get("chassis", ()), free)}
        forces = _resting(Model(bodies | frame("z rx"), scene.joints, scene.forces), scene).forces
        forces = {name: force for name, force in forces.items() if tyres or not name.endswith("_tyre")}
        return Model(bodies | frame(() if chassis == "held" else "z rx"), scene.joints, forces)

    def half(self, *, links: str = "rods", compliant: bool = True) -> Model:
        """The left half of the axle over the bump of its file, which both wheels meet at once: as the whole axle moves.

        A motion of both sides alike turns or moves nothing across the plane y = 0: half of the chassis heaves, half of
        the subframe moves in x and z and pitches, half of the rack is fixed to what carries it, the bar does not twist,
        nor does it bend; of a twist beam the middle stays in that plane and upright to it; a solid axle slides along
        it, without links across (`SolidAxle`).
        Names, preloads and joints are those of `model(chassis="guided", tyres=True)` on the left.

        Arguments:
            links, compliant: as in `model`.

        Raises `ValueError` for an axle whose sides have numbers of their own, and as `model`.
        """
        if self.other is not None:
            raise ValueError("`other`: an axle with another corner on the right has no half; leave it out, None.")
        car = self.left
        road = BumpRoad(height=car.bump_height, duration=car.bump_duration)
        _, joints = self._between(compliant)
        joints.pop("steering", None)
        if self.rack is not None:
            joints[f"rack_{self.rack.carrier}"] = FixedJoint(self.rack.carrier, "rack", at=self.rack.part.centre)
        scene = self._sides({"left": car}, joints, links, compliant, road)
        ends = lambda body: scene.ends.get(body, ())
        bodies = scene.bodies | {"chassis": car.chassis.body(ends("chassis"), "z")}
        if self.subframe is not None:
            free = ALL_FREE if "subframe" in joints else "x z ry"
            bodies["subframe"] = self.subframe.halved().body(ends("subframe"), free)
        if self.rack is not None:
            bodies["rack"] = self.rack.part.halved().body(ends("rack"))
        return _resting(Model(bodies, scene.joints, scene.forces), scene)

    def _sides(
        self, cars: dict[str, QuarterCar], joints: dict[str, Any], links: str, compliant: bool, road: Any
    ) -> CornerScene:
        """These corners and their parts of the bar, beside `joints`; with the tyres among what is sought."""
        check_choice("links", links, ("bodies", "rods"))
        forces: dict[str, Any] = {"gravity": Gravity((0.0, 0.0, -GRAVITY))}
        bodies, ends, sought, given = {}, {}, [], {}
        cars = cars if compliant else {side: car.rigid() for side, car in cars.items()}
        name, solid = f"Suspension {self.name!r}", self.solid_axle
        for side, car in cars.items():
            if solid is None and (side == "left" or self.other is not None):
                check_corner(car, name)
        if solid is not None and len(cars) == 2:
            solid.check(name, cars, compliant)
        elif solid is not None:
            cars = {side: solid.corner(car) for side, car in cars.items()}
            check_corner(cars["left"], name)
        held = [part.link for part in self._spanning]
        if self.twist_beam is not None and (compliant or len(cars) == 2):
            cars = {side: self.twist_beam.instead(car) for side, car in cars.items()}
        for side, car in cars.items():
            mounts = car.mounts if compliant else {}
            scene = corner_scene(car, wheel="locked", links=links, side=side, mounts=mounts, held=held)
            bodies, joints, forces = bodies | scene.bodies, joints | scene.joints, forces | scene.forces
            for body, masses in scene.ends.items():
                ends.setdefault(body, []).extend(masses)
            tyre = {"at": _over_contact(car.wheel.stance), "stiffness": car.tyre_stiffness, "road": road}
            forces[f"{side}_tyre"] = TyreSpring(f"{side}_wheel", **tyre)
            sought, given = [*sought, f"{side}_tyre", *scene.sought], given | scene.given
        for part in self._spanning:
            more = part.scene(cars, compliant)
            bodies, joints, forces = bodies | more.bodies, joints | more.joints, forces | more.forces
            sought, given = [*sought, *more.sought], given | more.given
        return CornerScene(bodies, joints, forces, ends, sought, given)

    def _between(self, compliant: bool) -> tuple[dict[str, Part], dict[str, Any]]:
        """The bodies that both sides share, and their joints."""
        shared, joints = {"chassis": self.left.chassis.joined(self.right.chassis)}, {}
        if self.subframe is not None:
            shared["subframe"] = self.subframe
            if not (compliant and any(mount.at is not None for mount in self.left.mounts.values())):
                joints["subframe"] = FixedJoint("chassis", "subframe", at=self.subframe.centre)
        if self.rack is not None:
            shared["rack"] = self.rack.part
            line: dict[str, Any] = {"at": self.rack.part.centre, "axis": self.rack.axis}
            joints[f"rack_{self.rack.carrier}"] = PrismaticJoint(self.rack.carrier, "rack", **line)
            joints["steering"] = TranslationDriver(self.rack.carrier, "rack", **line)
        return shared, joints


def _over_contact(stance: Stance) -> Float[Array, "3"]:
    """The point of a wheel, which does not spin here, over its contact centre, as high as its centre [m]: the force of
    the tyre goes through both, and turns of the wheel lift both alike."""
    return stance.contact.at[2].set(stance.centre[2])


def _resting(model: Model, scene: CornerScene) -> Model:
    """The model at rest by the preloads that are sought, of which those that are given then take their place."""
    forces = static_preload(model, scene.sought)[0].forces
    return Model(model.bodies, model.joints, forces | scene.given)
