"""The quarter-car of the paper's §9 with a real five-link rear suspension."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float, suggestion
from lgsens.analysis import Kinematics, kinematics
from lgsens.examples._axle_parts import Mount, Stop
from lgsens.examples._bending import bending, rigid, with_nodes
from lgsens.examples._corner_check import GRAVITY, check_corner
from lgsens.examples._corner_scene import corner_scene, joints_of
from lgsens.examples._file_axes import FileAxes
from lgsens.examples._hardpoint_file import read
from lgsens.examples._leaf_pack import LeafPack
from lgsens.examples._link_beam import ELEMENTS, SectionShape
from lgsens.examples._road_response import RoadResponse, road_response
from lgsens.examples._suspension_curves import SuspensionCurves, suspension_curves
from lgsens.examples._suspension_file import members
from lgsens.examples._suspension_parts import (
    BOTH_SIDES,
    PLANAR,
    Connection,
    Link,
    Part,
    Strut,
    numbered,
    reflected,
    regrouped,
)
from lgsens.examples._wheel import Wheel
from lgsens.model import (
    ALL_FREE,
    BeamSection,
    BumpRoad,
    Gravity,
    Model,
    PrismaticJoint,
    TranslationDriver,
    TyreSpring,
    static_preload,
)

ALONG_Z: Any = (0.0, 0.0, 1.0)


class QuarterCar(eqx.Module):
    """A quarter-car with any independent suspension: its data, all numbers leaves. `QuarterCar.load()` reads them.

    Chassis, knuckle, wheel and links are rigid bodies, but for links that bend (`bending`, or `beam` in the file):
    `Link` says how a link holds on, and `joints` are all others.
    The wheel turns on a hinge of the knuckle or is locked to it; the chassis heaves only. The five-link suspension is
    of eight bodies; with 48 coordinates and 45 (46) constraints it has 3 (2) degrees of freedom, a reduced scene the
    same with 19 and 16 (17), see `model`. Frame: x forward, y left, z up over the road; SI units.

    Source: Sonneville & Brüls (2014), §9; each file names that of its hardpoints, masses and rates.
    """

    name: str = eqx.field(static=True)
    links: dict[str, Link]
    joints: dict[str, Connection]
    knuckle: Part
    wheel: Wheel
    chassis: Part
    bearing: Float[Array, "3"]
    spring: Strut | None
    damper: Strut
    tyre_stiffness: Float[Array, ""]
    link_radius: Float[Array, ""] | None
    bump_height: Float[Array, ""]
    bump_duration: Float[Array, ""]
    mounts: dict[str, Mount] = eqx.field(default_factory=dict)  # in its axle, by the joints that they replace
    stops: dict[str, Stop] = eqx.field(default_factory=dict)
    carriers: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())  # what holds on to subframe or rack
    axes: FileAxes = eqx.field(static=True, default=FileAxes())
    leaf_spring: LeafPack | None = None  # in place of a spring, of half of a solid axle

    @staticmethod
    def load(path: str | Path | None = None) -> "QuarterCar":
        """Read a suspension from a file.

        Arguments:
            path: a TOML or JSON file in the format of `lgsens/examples/_suspension_file.py`, or the name of one that
                ships with lgsens, in `lgsens/examples/data`: "five_link_suspension", "double_wishbone", "push_rod",
                "multi_link", "mcpherson", "semi_trailing_arm", "twist_beam", "solid_axle", "leaf_springs";
                None: the first of them.

        Raises `ValueError` naming the file and the key (or the line) for a file that cannot be read, is incomplete, or
        describes a suspension that does not move as one: another freedom than travel, singular universal joints,
        motion ratios that no car has.
        """
        with jax.ensure_compile_time_eval():  # the file's numbers are constants, inside `jit` too
            car, name = QuarterCar._read(path)
            check_corner(car, f"Hardpoint file {name!r}")
            return car

    @staticmethod
    def _read(path: str | Path | None) -> tuple["QuarterCar", str]:
        """A car that is not checked yet, and what its file is called."""
        document, name = read(path)
        return with_nodes(QuarterCar(**members(document, name))), name

    def mirrored(self) -> "QuarterCar":
        """The corner of the other side: its mirror image in the plane y = 0, S = diag(1, −1, 1).

        Points and directions, of hinges and arms too, become S x, inertias S J S: products of inertia with y change
        their sign, principal moments about the axes of the file stay. Rates, masses and lengths stay. A turn about an
        axis n is one about −S n, so what was right-handed is left-handed: a screw would change the sign of its pitch.
        Camber, toe and the other curves, whose signs are those of the wheel's side, are the same.
        """
        axes = self.axes._replace(mirrored=not self.axes.mirrored)
        return dataclasses.replace(reflected(self), axes=axes)

    def bending(
        self, sections: Mapping[str, BeamSection | SectionShape], *, elements: int = ELEMENTS, up=None
    ) -> "QuarterCar":
        """The car with links that bend: uniform beams between their two ends, of the mass of their sections.

            car.bending({"trailing_arm": lg.BeamSection.tube(0.03, 0.003, young=2.1e11, poisson=0.3, density=7850.0)})

        Arguments:
            sections: by link; a `SectionShape` keeps diameter and wall among the numbers of the car.
            elements: of each, static.
            up: as of a `Beam`; None: z, of a link that is nearly upright x.

        In the scene they have the bodies "trailing_arm.0" … "trailing_arm.4", node 0 at the first end by the names of
        its bodies, and as elements the forces "trailing_arm.0" … "trailing_arm.3" (`SectionState`). What a link carries
        holds on to the nearest node, which is settled here: points and sections may be traced afterwards, sections now
        too. Raises `ValueError` for links that the car does not have or that other than two ends hold, stiffness that
        is not of principal axes, points that are traced already, and as `Beam`.
        """
        return bending(self, sections, elements, up)

    def rigid(self) -> "QuarterCar":
        """The car with links of the masses of their beams that do not bend: the limit of stiff ones."""
        return rigid(self)

    def scene_name(self, body: str, key: str, own: str = "") -> str:
        """What a body of the corner is called in a scene by what holds on to it: of a beam one of its nodes."""
        link = self.links.get(body)
        return own + (body if link is None or link.beam is None else link.beam.node(body, key))

    @property
    def on_chassis(self) -> dict[str, Array]:
        """By link or joint, in order, the points at which it holds on to the chassis [m], shape (3,) or (2, 3)."""
        links = {name: link.chassis for name, link in sorted(self.links.items()) if "chassis" in link.ends}
        joints = {name: c for name, c in sorted(joints_of(self).items()) if "chassis" in c.between}
        return links | {name: joint.at for name, joint in joints.items() if joint.kind != PLANAR}

    @property
    def hardpoints(self) -> Float[Array, "n 3"]:
        """Where links and joints hold on to the chassis [m], shape (n, 3), as `hardpoint_names` says."""
        return jnp.concatenate([jnp.atleast_2d(points) for points in self.on_chassis.values()])

    @property
    def hardpoint_names(self) -> list[str]:
        """The links in sorted order, then the joints; of one with two points "NAME 1" and "NAME 2"."""
        return numbered(self.on_chassis)

    @property
    def mass(self) -> Float[Array, ""]:
        """Of all bodies [kg]."""
        own = [link.own_mass for link in self.links.values()]
        own += [] if self.leaf_spring is None else [self.leaf_spring.own_mass]
        return jnp.sum(jnp.stack([self.chassis.mass, self.knuckle.mass, self.wheel.mass, *own]))

    def with_values(self, *, stiffness=None, damping=None, bump_height=None, hardpoints=None) -> "QuarterCar":
        """The car with some numbers replaced; None: it keeps its own.

        Arguments:
            stiffness, damping, bump_height: of spring [N/m] and damper [N s/m], of curves the slopes at the design
                position and at rest, with which the curves grow; and of the bump [m], shape ().
            hardpoints: as the property [m], shape (n, 3).

        Raises `ValueError` for other shapes, and a stiffness where there are leaf springs.
        """
        if self.spring is None and stiffness is not None:
            raise ValueError("`stiffness`: the car is on leaf springs; what they are made of is in `leaf_spring`.")
        numbers = [damping, bump_height] if self.spring is None else [stiffness, damping, bump_height]
        rates = lambda car: [strut.rate for strut in (car.spring, car.damper) if strut is not None]
        where = lambda car: [*rates(car), car.bump_height, *car.on_chassis.values()]
        olds = where(self)
        points: list[Any] = [None] * (len(olds) - len(numbers))
        if hardpoints is not None:
            rows = as_float(hardpoints, (len(self.hardpoint_names), 3), "`hardpoints`")
            points = regrouped(rows, olds[len(numbers) :])
        values = [
            old if new is None else as_float(new, old.shape, "`stiffness`, `damping` or `bump_height`")
            for old, new in zip(olds, (*numbers, *points))
        ]
        return eqx.tree_at(where, self, values)

    def model(
        self,
        *,
        wheel: str = "hinged",
        chassis: str = "guided",
        links: str = "bodies",
        bushings: Sequence[str] = (),
        bushing_stiffness=1e8,
        bushing_damping=1e4,
        free_length=None,
        free_radius=None,
    ) -> Model:
        """The scene at rest on its springs at the design position, a bump ahead.

        Arguments:
            wheel: "hinged" (45 constraints, 3 degrees of freedom) or "locked" (46 and 2).
            chassis: "guided" by a prismatic joint (6 coordinates, 5 constraints), or "heave": a body that has that
                one coordinate. The motion is the same.
            links: "bodies", or "rods": links that are uniform bars and carry nothing become massless rods
                (`DistanceJoint`), 1 constraint for 6 coordinates and 7 constraints each. Half the mass of each
                goes to either end, on the bodies there, whose centres of mass and inertias move with it. Mass and
                centre of mass of a bar stay so, and with them the static forces; its moment of inertia about its
                centre becomes m L²/4 for m L²/12. A link that carries the spring or the damper is bent and not only
                pulled, and remains a body. Links that bend do in either.
            bushings: the links that a `Bushing` holds at the knuckle in place of a ball joint: 3 constraints less each.
                Such a link remains a body.
            bushing_stiffness, bushing_damping: of those bushings, in every direction [N/m] and [N s/m].
            free_length: free length of the spring [m]. None: the preloads of spring, tyre, bushings and beams are those
                that hold the car at the design position, whatever the parameters, and so are their derivatives.
            free_radius: free radius of the tyre [m], with `free_length`.

        Raises `ValueError` for an unknown kind of wheel, chassis or links, for bushings at links that the car does not
        have or that have no ball joint at the knuckle, and where preloads are sought as `load` for a suspension that
        does not move as one.
        """
        check_choice("wheel", wheel, ("hinged", "locked"))
        check_choice("chassis", chassis, ("guided", "heave"))
        check_choice("links", links, ("bodies", "rods"))
        jointed = [name for name, link in self.links.items() if "knuckle" in link.balls]
        for name in bushings:
            if name not in jointed:
                raise ValueError(
                    f"`bushings`: {suggestion(name, jointed)}, the links with a ball joint at the knuckle."
                )
        along = lambda rate: jnp.full(3, rate, self.bearing.dtype)
        mount = Mount(along(bushing_stiffness), along(bushing_damping))
        scene = corner_scene(self, wheel=wheel, links=links, mounts={f"{name}_knuckle": mount for name in bushings})
        free = "z" if chassis == "heave" else ALL_FREE
        bodies = scene.bodies | {"chassis": self.chassis.body(scene.ends.get("chassis", ()), free)}
        joints = dict(scene.joints)
        if chassis == "guided":
            joints["heave"] = PrismaticJoint(None, "chassis", at=self.chassis.centre, axis=ALONG_Z)
        road = BumpRoad(height=self.bump_height, duration=self.bump_duration)
        tyre = {"stiffness": self.tyre_stiffness, "free_radius": free_radius, "road": road}
        forces = {"gravity": Gravity((0.0, 0.0, -GRAVITY))} | scene.forces
        forces |= {"tyre": TyreSpring("wheel", at=self.wheel.centre, **tyre)}
        called = {f"{name}_knuckle": f"{name}_bushing" for name in bushings}
        forces = {called.get(name, name): force for name, force in forces.items()}
        if free_length is not None:
            if self.spring is None:
                raise ValueError("`free_length` is of a spring, and the car is on leaf springs; leave it out, None.")
            forces["spring"] = self.spring.element("spring", free_length, lambda body: self.scene_name(body, "spring"))
        model = Model(bodies, joints, forces)
        if free_length is not None:
            return model
        check_corner(self, f"Suspension {self.name!r}")  # else no preload holds it, or one that no car has
        return static_preload(model, ("tyre", *(called.get(name, name) for name in scene.sought)))[0]

    def travel(self, travel, *, links: str = "rods", throw: bool = True) -> Kinematics:
        """The suspension on a rig: the chassis held, the wheel locked, its centre moved up and down at rate 1; no link
        bends.

        Arguments:
            travel: vertical displacements of the wheel centre [m], positive in bump, shape (n,), in an order in which
                each is near the one before.
            links: as in `model`; the motion is the same.
            throw: as in `lgsens.kinematics`.

        Velocities and rates are derivatives by the travel. The forces are not those of the car: its spring has no
        preload here. Raises `ValueError` for travel that the links do not allow, and on leaf springs.
        """
        if self.leaf_spring is not None:
            raise ValueError(
                f"Suspension {self.name!r} is guided by leaf springs, which bend as it travels: take the rig, "
                "`rigs.kc` or `lgsens kc`."
            )
        # Lengths that are given need no preload to be found.
        scene = self.rigid().model(wheel="locked", chassis="heave", links=links, free_length=1.0, free_radius=1.0)
        driver = TranslationDriver(None, "wheel", at=self.wheel.centre, axis=ALONG_Z)
        held = {"chassis": self.chassis.body(free=())}
        rig = Model(scene.bodies | held, scene.joints | {"travel": driver}, scene.forces)
        return kinematics(rig, {"travel": travel}, throw=throw)

    def curves(self, travel, *, axle: str = "rear", throw: bool = True) -> SuspensionCurves:
        """Camber, toe, track, wheelbase, motion ratios and roll centre over the travel of the wheel.

        Arguments:
            travel: as in `travel`.
            axle: "rear" or "front", for the sign of the wheelbase.
            throw: as in `lgsens.kinematics`.

        `SuspensionCurves` says what they are and their signs (ISO 8855). Differentiable by every number of the
        suspension, exactly. Raises `ValueError` for another axle and as `travel`.
        """
        check_choice("axle", axle, ("rear", "front"))
        alone = not any(joint.kind in BOTH_SIDES for joint in self.joints.values())
        return suspension_curves(self.travel(travel, throw=throw), self.wheel.stance, rear=axle == "rear", alone=alone)

    def random_road(self, *, roughness, speed, weighting: str | None = "Wk") -> RoadResponse:
        """What a random road of ISO 8608 does to the car, by its linear equations about the design position.

        Arguments:
            roughness: G_d(0.1 cycles/m) [m³], shape (), positive, or the class of the road, "A" to "H".
            speed: V [m/s], shape (), positive.
            weighting: of the acceleration, by the name of a `FrequencyWeighting`; None: none.

        The wheel is locked: one that turns freely does not settle, nor do beams without `damping`. Differentiable by
        every number of the car, by the adjoint Lyapunov equation. Raises `ValueError` as `lgsens.random_road`. Source:
        `lgsens.random_road`.
        """
        return road_response(self, roughness=roughness, speed=speed, weighting=weighting)


def stiff_quarter_car(car: QuarterCar, *, wheel: str = "locked", **settings: Any) -> Model:
    """The quarter-car with bushings of 1e8 N/m in place of the ball joints of wishbone and guide link, at rest.

    Beside its own modes, 10 and 57 rad/s, it has six between 730 and 18 000 rad/s, the fastest nearly critically
    damped; Ψ₀ is that of ball joints to 1e-3. Explicit integrators must take steps of 0.2 ms or less.

    Arguments:
        car: the suspension, `QuarterCar.load()`.
        wheel: as in `QuarterCar.model`, and so are `settings`; `bushing_stiffness=` and `bushing_damping=` among them.
    """
    return car.model(wheel=wheel, bushings=("wishbone", "guide_link"), **settings)


def check_choice(name: str, value: str, known: tuple[str, str]) -> None:
    """One of two settings."""
    if value not in known:
        raise ValueError(f"`{name}` must be {known[0]!r} or {known[1]!r}, got {value!r}.")
