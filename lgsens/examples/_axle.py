"""An axle: two corners, and what is between them."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.examples._axle_file import axle_members
from lgsens.examples._axle_parts import Bar, Rack
from lgsens.examples._corner_scene import corner_scene
from lgsens.examples._hardpoint_file import read
from lgsens.examples._quarter_car import GRAVITY, QuarterCar, check_choice
from lgsens.examples._suspension_file import reader
from lgsens.examples._suspension_parts import Part, reflected
from lgsens.model import FixedJoint, Gravity, Model, PrismaticJoint, TranslationDriver, TyreSpring, static_preload


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
    """

    left: QuarterCar
    other: QuarterCar | None = None
    subframe: Part | None = None
    rack: Rack | None = None
    bar: Bar | None = None

    @staticmethod
    def load(path: str | Path | None = None) -> "Axle":
        """Read an axle from the file of a suspension: its corner, the mirror image, and the tables of an axle.

        Arguments:
            path: as of `QuarterCar.load`; the corner of the file is on either side.

        Raises `ValueError` naming the file and the key as `QuarterCar.load`.
        """
        with jax.ensure_compile_time_eval():
            corner = QuarterCar.load(path)
            root, kilogram = reader(*read(path))
            axle = Axle(corner, **axle_members(root, kilogram, [*corner.links]))
            return axle if corner.wheel.centre[1] > 0 else reflected(axle)

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

    @property
    def mass(self) -> Float[Array, ""]:
        """Of all bodies [kg]: of two quarters of a car, and what is between them."""
        between = [self.subframe, None if self.rack is None else self.rack.part, self.bar]
        every = [self.left, self.right, *(part for part in between if part is not None)]
        return jnp.sum(jnp.stack([part.mass for part in every]))

    def two_sided(self) -> "Axle":
        """The same axle with numbers of its own on each side."""
        return Axle(self.left, self.right, self.subframe, self.rack, self.bar)

    def model(
        self, *, chassis: str = "held", links: str = "bodies", compliant: bool = True, tyres: bool = False
    ) -> Model:
        """The scene at the design position, in which it rests under the loads of its wheels.

        Bodies are `chassis`, `subframe`, `rack`, and of each side `left_knuckle`, `left_wheel`, which is locked to it,
        `left_anti_roll_bar`, and `left_LINK` of every link. Joints are `left_hub`, `left_LINK_BODY`, those of the file
        (`left_NAME`), `left_drop_link`, and `steering`, which holds the rack at its design position; forces `gravity`,
        `left_spring`, `left_damper`, `left_NAME` of bushings (of a hinge `left_NAME_1` and `_2`), `left_subframe_NAME`,
        `left_bump_stop`, `anti_roll_bar`, `left_tyre`.

        Arguments:
            chassis: "held", or "guided": it heaves, and rolls about its centre of mass.
            links: "bodies", or "rods" as in `QuarterCar.model`; a link with a bushing remains a body.
            compliant: whether there are bushings. False: each is the joint that it replaces, the subframe is fixed to
                the chassis.
            tyres: whether the wheels stand on a road, on `TyreSpring`s at their centres.

        The preloads of springs, tyres and bushings are those with which the whole car, guided and on tyres, rests:
        of those that do, the bushings' are of least energy (`static_preload`). Bushings with preloads of their own keep
        them, and the car then rests elsewhere. Raises `ValueError` for an unknown kind of chassis or links, and as
        `QuarterCar.model`.
        """
        check_choice("chassis", chassis, ("held", "guided"))
        check_choice("links", links, ("bodies", "rods"))
        cars = {"left": self.left, "right": self.right}
        for car in (self.left, *(() if self.other is None else (self.other,))):
            car._check(f"Suspension {self.name!r}")
        shared, joints = self._between(compliant)
        forces: dict[str, Any] = {"gravity": Gravity((0.0, 0.0, -GRAVITY))}
        bodies: dict[str, Any] = {}
        ends: dict[str, list[Any]] = {name: [] for name in shared}
        sought = []
        for side, car in cars.items():
            mounts, held = car.mounts if compliant else {}, () if self.bar is None else (self.bar.link,)
            scene = corner_scene(car, wheel="locked", links=links, side=side, mounts=mounts, held=held)
            bodies, joints, forces = bodies | scene.bodies, joints | scene.joints, forces | scene.forces
            for body, masses in scene.ends.items():
                ends[body] += masses
            tyre = TyreSpring(f"{side}_wheel", at=car.wheel.centre, stiffness=car.tyre_stiffness)
            forces[f"{side}_tyre"] = tyre
            sought += [f"{side}_tyre", *scene.sought]
            if self.bar is not None:
                bar = self.bar if side == "left" else reflected(self.bar)
                bodies[f"{side}_anti_roll_bar"] = bar.half().body()
                joints |= bar.joints(side)
        if self.bar is not None:
            forces["anti_roll_bar"] = self.bar.element("left_anti_roll_bar", "right_anti_roll_bar")
        bodies |= {name: part.body(ends[name]) for name, part in shared.items() if name != "chassis"}
        frame = lambda free: {"chassis": shared["chassis"].body(ends["chassis"], free)}
        forces = static_preload(Model(bodies | frame("z rx"), joints, forces), sought)[0].forces
        forces = {name: force for name, force in forces.items() if tyres or not name.endswith("_tyre")}
        return Model(bodies | frame(() if chassis == "held" else "z rx"), joints, forces)

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
