"""Exudyn, a C++ multibody code with absolute coordinates: the quarter-car and the chain, at several settings.

The mechanism is built from Exudyn's own rigid bodies, joints and spring-dampers; the bump is a symbolic user function,
evaluated in C++. Output and files are off, one thread. Each of its generic joints carries six multipliers, those of the
free axes being zero, so the system has 12 rows more than lgsens's.

Newton's tolerance is the tightest of 1e-10, 1e-9 and 1e-8 (relative and absolute) at which every step converges:
round-off in the residual, which index 3 does not scale, lets few settings reach 1e-10. Rows at Exudyn's default
tolerance (1e-8) stand beside them.
"""

import importlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from exudyn_solver import FULL, MODIFIED, PER_STEP, converges, fast, solver_settings
from rival_scenes import SCENES, Numbers, Scene
from rival_timing import Program

TOLERANCES = (1e-10, 1e-9, 1e-8)


class Options(NamedTuple):
    """Settings of the solver."""

    solver: str
    linear: str
    newton: str
    nodes: str = "NodeRigidBodyRotVecLG"  # rotation vectors on the Lie group
    tolerances: Sequence[float] = TOLERANCES


OPTIONS = (
    Options("GeneralizedAlpha", "EXUdense", FULL),
    Options("GeneralizedAlpha", "EXUdense", MODIFIED),
    Options("GeneralizedAlpha", "EigenSparse", FULL),
    Options("GeneralizedAlpha", "EigenSparse", PER_STEP),
    Options("GeneralizedAlpha", "EigenSparse", MODIFIED),
    Options("TrapezoidalIndex2", "EigenSparse", FULL),
    Options("TrapezoidalIndex2", "EigenSparse", MODIFIED),
    *(
        Options("GeneralizedAlpha", "EigenSparse", MODIFIED, nodes, (1e-8,))
        for nodes in ("NodeRigidBodyRotVecLG", "NodeRigidBodyEP", "NodeRigidBodyRxyz")
    ),
    Options("TrapezoidalIndex2", "EigenSparse", MODIFIED, "NodeRigidBodyRotVecLG", (1e-8,)),
    Options("TrapezoidalIndex2", "EigenSparse", MODIFIED, "NodeRigidBodyRxyz", (1e-8,)),
)
FASTEST = OPTIONS[8]  # of them, on the quarter-car


def version() -> str:
    return fast().__version__


CHAIN_OPTIONS = tuple(
    Options(solver, "EigenSparse", newton, tolerances=(*TOLERANCES, 1e-7, 1e-6))
    for solver, newton in (("GeneralizedAlpha", FULL), ("GeneralizedAlpha", MODIFIED), ("TrapezoidalIndex2", MODIFIED))
)


class Mechanism:
    """The quarter-car in Exudyn."""

    def __init__(self, scene: Scene, numbers: Numbers, options: Options, observe: bool):
        self.exu, self.items = fast(), importlib.import_module("exudyn.itemInterface")
        self.container = self.exu.SystemContainer()
        self.mbs = self.container.AddSystem()
        self.numbers, self.scene, self.options = numbers, scene, options
        n = len(scene.bodies)
        self.nodes, self.objects = [], []
        for i in range(n):
            self._add_body(i)
        self.objects.append(self.mbs.AddObject(self.items.ObjectGround()))
        self._add_weights()
        if scene.topology.wheel is None:
            self._add_hinges()
        else:
            self._add_suspension()
            self._add_forces()
        self.sensor = None
        if observe:
            kind = getattr(self.exu.OutputVariableType, scene.observed[1].capitalize())
            body = self.objects[scene.bodies.index(scene.observed[0])]
            sensor = self.items.SensorBody(
                bodyNumber=body, storeInternal=True, writeToFile=False, outputVariableType=kind
            )
            self.sensor = self.mbs.AddSensor(sensor)
        self.mbs.Assemble()

    def _add_body(self, i: int) -> None:
        items, numbers = self.items, self.numbers
        inertia = numbers.inertia[i]
        rotation = [1.0, 0.0, 0.0, 0.0] if self.options.nodes == "NodeRigidBodyEP" else [0.0, 0.0, 0.0]
        kind = getattr(items, self.options.nodes)
        rates = [*numbers.velocity[i], *numbers.spin[i]] if len(rotation) == 3 else [*numbers.velocity[i], *np.zeros(4)]
        reference = [*numbers.position[i], *rotation]
        node = self.mbs.AddNode(kind(referenceCoordinates=reference, initialVelocities=rates))
        self.nodes.append(node)
        body = items.ObjectRigidBody(
            nodeNumber=node,
            physicsMass=numbers.mass[i],
            physicsInertia=[*np.diag(inertia), inertia[1, 2], inertia[0, 2], inertia[0, 1]],
        )
        self.objects.append(self.mbs.AddObject(body))

    def _marker(self, body: int, point, rigid: bool = True) -> Any:
        kind = self.items.MarkerBodyRigid if rigid else self.items.MarkerBodyPosition
        return self.mbs.AddMarker(kind(bodyNumber=self.objects[body], localPosition=list(point)))

    def _generic(self, ends, points, axes, frame) -> None:
        """A joint whose frame has the columns of `frame`; all bodies start unrotated."""
        markers = [self._marker(*end) for end in zip(ends, points)]
        joint = self.items.GenericJoint(
            markerNumbers=markers, constrainedAxes=axes, rotationMarker0=frame, rotationMarker1=frame
        )
        self.mbs.AddObject(joint)

    def _add_hinges(self) -> None:
        """A chain: each coincidence with its two orthogonalities is a hinge about x of the joint's frame."""
        numbers, ends = self.numbers, self.scene.topology.coincident
        first, axes = numbers.orthogonal
        for i, (end, *points) in enumerate(zip(ends, *numbers.coincident)):
            frame = np.stack([axes[i], first[i], np.cross(axes[i], first[i])], axis=1)
            self._generic(end, points, [1, 1, 1, 0, 1, 1], frame)

    def _add_suspension(self) -> None:
        """Heave and hub as they are; of the coincidences those with the chassis carry the universal joints."""
        numbers, topology = self.numbers, self.scene.topology
        ends, (points_a, points_b) = topology.coincident, numbers.coincident
        ground, chassis = topology.in_plane[0]
        places = (numbers.in_plane[0][0], numbers.in_plane[1][0])
        self._generic((ground, chassis), places, [1, 1, 0, 1, 1, 1], np.eye(3))
        self._generic(ends[0], (points_a[0], points_b[0]), [1, 1, 1, 1, 1, 1], np.eye(3))
        links = len(ends) // 2
        for i in range(1, 1 + links):
            y, z = (axes[5 + i] for axes in numbers.orthogonal)  # y of a stays orthogonal to z of b
            frame = np.stack([np.cross(y, z), y, z], axis=1)
            self._generic(ends[i], (points_a[i], points_b[i]), [1, 1, 1, 1, 0, 0], frame)
        for (a, b), point_a, point_b in zip(ends[1 + links :], points_a[1 + links :], points_b[1 + links :]):
            markers = [self._marker(a, point_a, rigid=False), self._marker(b, point_b, rigid=False)]
            self.mbs.AddObject(self.items.SphericalJoint(markerNumbers=markers))

    def _add_weights(self) -> None:
        for i, mass in enumerate(self.numbers.mass):
            marker = self._marker(i, np.zeros(3), rigid=False)
            self.mbs.AddLoad(self.items.Force(markerNumber=marker, loadVector=list(mass * self.numbers.gravity)))

    def _add_forces(self) -> None:
        items, numbers, topology = self.items, self.numbers, self.scene.topology
        for (a, b), point_a, point_b, k, c, length, preload in zip(topology.springs, *numbers.springs):
            markers = [self._marker(a, point_a, rigid=False), self._marker(b, point_b, rigid=False)]
            spring = items.ObjectConnectorSpringDamper(
                markerNumbers=markers, stiffness=k, damping=c, referenceLength=length, force=preload
            )
            self.mbs.AddObject(spring)
        stiffness, radius, preload, height, duration = (float(x) for x in numbers.tyre)
        wheel = self._marker(topology.wheel, np.zeros(3), rigid=False)
        free = [*numbers.position[topology.wheel][:2], radius + preload / stiffness]
        ground = self._marker(len(numbers.mass), free, rigid=False)
        tyre = items.CartesianSpringDamper(markerNumbers=[ground, wheel], stiffness=[0.0, 0.0, stiffness])
        self.mbs.AddObject(tyre)
        self._add_bump(wheel, stiffness * height, duration)

    def _add_bump(self, wheel, force: float, duration: float) -> None:
        symbolic = self.exu.symbolic
        utilities = importlib.import_module("exudyn.advancedUtilities")

        def bump(mbs, t, load):
            wave = symbolic.sin(t * (np.pi / duration))
            return [0.0 * load[0], 0.0 * load[1], symbolic.IfThenElse(t <= duration, load[2] * wave * wave, 0.0 * t)]

        load = self.mbs.AddLoad(self.items.Force(markerNumber=wheel, loadVector=[0.0, 0.0, force]))
        self.bump = utilities.CreateSymbolicUserFunction(self.mbs, bump, "loadVectorUserFunction", load)
        self.mbs.SetLoadParameter(load, "loadVectorUserFunction", self.bump)

    def settings(self, tolerance: float) -> Any:
        scene, options = self.scene, self.options
        settings = solver_settings(self.exu, scene.t1, scene.num_steps, options.linear, options.newton, tolerance)
        settings.timeIntegration.solverType = getattr(self.exu.DynamicSolverType, options.solver)
        settings.solution.sensors.writePeriod = scene.t1 / scene.num_steps
        return settings

    def solve(self, settings: Any) -> bool:
        return converges(self.exu, self.mbs, settings)

    def value(self) -> float:
        """Ψ of the solution, of a mechanism that is observed."""
        found = np.asarray(self.mbs.GetSensorStoredData(self.sensor))
        return float(np.trapezoid(found[:, 1 + self.scene.observed[2]] ** 2, found[:, 0]))


def _program(scene: Scene, numbers: Numbers, options: Options) -> Program | None:
    """The program with the tightest tolerance that converges; Ψ comes from a run that observes the acceleration."""
    observed = Mechanism(scene, numbers, options, observe=True)
    tolerance = next((tol for tol in options.tolerances if observed.solve(observed.settings(tol))), None)
    if tolerance is None:
        return None
    value = observed.value()
    mechanism = Mechanism(scene, numbers, options, observe=False)
    settings = mechanism.settings(tolerance)

    def call():
        mechanism.solve(settings)
        return value, None

    nodes = options.nodes.removeprefix("NodeRigidBody")
    return Program(
        rival="Exudyn",
        program=f"{options.solver}, {options.linear}, {options.newton}, {nodes}, {tolerance:.0e}",
        kind="forward",
        num_steps=scene.num_steps,
        basis="equal step",
        call=call,
        details={"tolerance": tolerance},
    )


_PROCESS: dict[str, Scene] = {}  # in a process of `batches.py`: its scene


def begin(name: str, ready: Any) -> None:
    """What a process does first."""
    _PROCESS["scene"] = SCENES[name]()
    fast()
    ready.wait()


def solved(numbers: Numbers) -> tuple[float, float]:
    """Ψ of a design, by `FASTEST`, and the seconds to build its mechanism."""
    started = time.perf_counter()
    mechanism = Mechanism(_PROCESS["scene"], numbers, FASTEST, observe=True)
    seconds = time.perf_counter() - started
    return (mechanism.value() if mechanism.solve(mechanism.settings(FASTEST.tolerances[0])) else np.nan), seconds


def programs(scene: Scene) -> list[Program]:
    """Forward simulations; a gradient takes one more for each parameter, by differences."""
    if scene.name == "top":
        return []
    numbers = scene.arrays()
    options = OPTIONS if scene.name == "quarter_car" else CHAIN_OPTIONS
    found = (_program(scene, numbers, choice) for choice in options)
    return [program for program in found if program is not None]
