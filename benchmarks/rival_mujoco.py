"""MuJoCo: the quarter-car as a tree of joints with four loops closed by its equality constraints, which are soft.

Chassis on a slide; each link on two hinges (a universal joint); the knuckle, with the wheel, on a ball joint of the
first link; its ball joints on the other four links are `connect` constraints, as stiff as MuJoCo advises (time constant
of two steps), so Ψ is not that of hard joints. Spring, damper and the tyre's stiffness are tendons, the tyre's one a
kilometre long so that it stays vertical; the bump is a control sequence, constant over a step. `mujoco.rollout` steps
in C.

The chain is a tree of hinges without loops, so in MuJoCo's coordinates there are no constraints: RK4 on N angles. Its Ψ
is the trapezoidal rule with the correction h²/12 of its ends, of fourth order too.
"""

import importlib
from typing import Any

import numpy as np
from rival_scenes import Numbers, Scene
from rival_timing import Program

DEPTH = 1000.0  # m, of the tyre's lower end
INTEGRATORS = ("implicitfast", "RK4")
CHAIN_STEPS = 3  # the fewest of RK4 with at least the accuracy in Ψ of 100 steps of generalized-α


def _text(values) -> str:
    return " ".join(format(float(value), ".17g") for value in values)


def _body(numbers: Numbers, name: str, i: int, parent, inside: str) -> str:
    inertia = numbers.inertia[i]
    moments = (*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2])
    return (
        f'<body name="{name}" pos="{_text(numbers.position[i] - parent)}">'
        f'<inertial pos="0 0 0" mass="{_text([numbers.mass[i]])}" fullinertia="{_text(moments)}"/>{inside}</body>'
    )


def _sites(scene: Scene, numbers: Numbers, body: int) -> str:
    found = ""
    for end in (0, 1):
        for i, point in enumerate(numbers.springs[end]):
            if scene.topology.springs[i, end] == body:
                found += f'<site name="spring{i}{"ab"[end]}" pos="{_text(point)}"/>'
    return found


def _xml(scene: Scene, numbers: Numbers, integrator: str) -> str:
    bodies, topology = scene.bodies, scene.topology
    chassis, knuckle, wheel = (bodies.index(name) for name in ("chassis", "knuckle", "wheel"))
    points_a, points_b = numbers.coincident
    links = len(topology.coincident) // 2
    h = scene.t1 / scene.num_steps
    inside, connects = "", ""
    for i in range(links):
        link = topology.coincident[1 + i, 1]
        arms = (numbers.orthogonal[side][6 + i] for side in (0, 1))
        joints = "".join(f'<joint type="hinge" pos="{_text(points_b[1 + i])}" axis="{_text(arm)}"/>' for arm in arms)
        last, outer, inner = "", points_b[1 + links + i], points_a[1 + links + i]
        if i == 0:
            centre = numbers.position[knuckle]
            tyre = _body(numbers, "wheel", wheel, centre, '<site name="wheel" pos="0 0 0"/>')
            ball = f'<joint type="ball" pos="{_text(inner)}"/>'
            last = _body(
                numbers, "knuckle", knuckle, numbers.position[link], ball + _sites(scene, numbers, knuckle) + tyre
            )
        else:
            connects += f'<connect body1="knuckle" body2="{bodies[link]}" anchor="{_text(inner)}"/>'
        assert np.allclose(numbers.position[link] + outer, numbers.position[knuckle] + inner)
        parts = joints + _sites(scene, numbers, link) + last
        inside += _body(numbers, bodies[link], link, numbers.position[chassis], parts)
    slide = '<joint type="slide" axis="0 0 1"/>'
    tree = _body(numbers, "chassis", chassis, np.zeros(3), slide + _sites(scene, numbers, chassis) + inside)
    tendons = ""
    for i, (k, c, length, preload) in enumerate(zip(*numbers.springs[2:])):
        free = length - preload / k if k else length
        tendons += (
            f'<spatial stiffness="{_text([k])}" damping="{_text([c])}" springlength="{_text([free])}">'
            f'<site site="spring{i}a"/><site site="spring{i}b"/></spatial>'
        )
    stiffness, radius, preload, *_ = numbers.tyre
    place = [*numbers.position[wheel][:2], -DEPTH]
    tendons += (
        f'<spatial stiffness="{_text([stiffness])}" springlength="{_text([DEPTH + radius + preload / stiffness])}">'
        '<site site="deep"/><site site="wheel"/></spatial>'
    )
    return (
        f'<mujoco><option timestep="{h}" gravity="{_text(numbers.gravity)}" integrator="{integrator}" '
        'tolerance="1e-12" jacobian="dense"><flag contact="disable"/></option>'
        f'<default><equality solref="{2 * h} 1" solimp="0.9999 0.9999 0.001"/></default>'
        f'<worldbody><site name="deep" pos="{_text(place)}"/><site name="origin"/>{tree}</worldbody>'
        f"<equality>{connects}</equality><tendon>{tendons}</tendon>"
        '<actuator><motor site="wheel" refsite="origin" gear="0 0 1 0 0 0"/></actuator>'
        '<sensor><framelinacc objtype="body" objname="chassis"/></sensor></mujoco>'
    )


def _state(mujoco: Any, model: Any, data: Any) -> np.ndarray:
    """Where a rollout begins."""
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def _chain_model(mujoco: Any, scene: Scene, numbers: Numbers, num_steps: int) -> Any:
    spec = mujoco.MjSpec()  # XML may not be nested so deep
    spec.option.timestep = scene.t1 / num_steps
    spec.option.gravity = numbers.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    body, at = spec.worldbody, np.zeros(3)
    for i, name in enumerate(scene.bodies):
        body = body.add_body(name=name, pos=numbers.position[i] - at, explicitinertial=True)
        body.mass, body.ipos, body.iquat = numbers.mass[i], np.zeros(3), np.eye(4)[0]
        body.inertia, at = np.diag(numbers.inertia[i]), numbers.position[i]
        hinge = {"pos": numbers.coincident[1][i], "axis": numbers.orthogonal[1][i]}
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, **hinge)
    for kind in ("FRAMEPOS", "FRAMELINVEL"):
        kind = getattr(mujoco.mjtSensor, f"mjSENS_{kind}")
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=scene.observed[0])
    return spec.compile()


def _chain(scene: Scene) -> list[Program]:
    mujoco: Any = importlib.import_module("mujoco")
    rollout = importlib.import_module("mujoco.rollout")
    numbers, axis = scene.arrays(), scene.observed[2]
    found = []
    for basis, num_steps in (("equal step", scene.num_steps), ("equal accuracy", CHAIN_STEPS)):
        model = _chain_model(mujoco, scene, numbers, num_steps)
        data = mujoco.MjData(model)
        data.qvel[0] = numbers.spin[0] @ numbers.orthogonal[1][0]  # the others turn with the first
        state = _state(mujoco, model, data)
        h = scene.t1 / num_steps

        def call(model=model, data=data, state=state, num_steps=num_steps, h=h):
            _, sensed = rollout.rollout(model, data, state[None], nstep=num_steps + 1)  # sensors at the start of a step
            z, rate = sensed[0, :, axis], sensed[0, :, 3 + axis]
            slope = 2 * z * rate
            return float(np.trapezoid(z**2, dx=h) - h**2 / 12 * (slope[-1] - slope[0])), None

        found.append(Program("MuJoCo", "RK4, angles", "forward", num_steps, basis, call))
    return found


def programs(scene: Scene) -> list[Program]:
    """Forward simulations; a gradient takes one more for each parameter, by differences."""
    if scene.name.startswith("chain"):
        return _chain(scene)
    if scene.name != "quarter_car":
        return []
    mujoco: Any = importlib.import_module("mujoco")
    rollout = importlib.import_module("mujoco.rollout")
    numbers = scene.arrays()
    h = scene.t1 / scene.num_steps
    stiffness, _, _, height, duration = numbers.tyre
    t = np.arange(scene.num_steps + 1) * h
    middle = t + h / 2
    control = np.where(middle < duration, stiffness * height * np.sin(np.pi * middle / duration) ** 2, 0.0)[:, None]
    found = []
    for integrator in INTEGRATORS:
        model = mujoco.MjModel.from_xml_string(_xml(scene, numbers, integrator))
        data = mujoco.MjData(model)
        state = _state(mujoco, model, data)

        def call(model=model, data=data, state=state):
            _, sensed = rollout.rollout(model, data, state[None], control[None])
            observed = sensed[0, :, 2] + numbers.gravity[2]  # what an accelerometer feels, less gravity
            return float(np.trapezoid(observed**2, t)), None

        found.append(Program("MuJoCo", f"{integrator}, soft loops", "forward", scene.num_steps, "equal step", call))
    return found
