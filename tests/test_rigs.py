"""K&C of axles against closed forms, kinematics, and a static solver of their energy that shares no code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.optimize import root
from small_axle import ARMS, POINTS, RATES, SIDES, arm_centre, numbers, small_axle

import lgsens as lg
from lgsens import rigs
from lgsens.rigs import Sweep, on_rig, standard_sweeps

STANDARD = standard_sweeps(travel=0.03, roll=0.02, rack=0.02, lateral=1000.0, braking=1000.0)
# Of a trailing arm [m]: its length, height of the hinge, track, wheel radius, place of the spring, half its bearing.
ARM = {"length": 0.42, "hinge": 0.37, "track": 1.5, "radius": 0.31, "spring_arm": 0.25, "half": 0.11}
ARM |= {"spring": 4e4, "bar": 700.0, "x": 3e6, "y": 2e6, "z": 5e6}


def trailing_arms(p, *, compliant: bool):
    """Two trailing arms, weightless springs without preload: every rate at the design position is elementary."""
    p = {name: jnp.asarray(value, float) for name, value in p.items()}
    place = lambda *xyz: jnp.stack([jnp.asarray(x, float) for x in xyz])
    bodies, joints, forces, centres = {}, {}, {}, {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        y, wheel = sign * p["track"] / 2, f"{side}_wheel"
        centres[side] = place(0.0, y, p["radius"])
        bodies[wheel] = lg.RigidBody(mass=30.0, inertia=(1.0, 1.0, 1.0), position=centres[side])
        hinge = lambda offset, y=y: place(p["length"], y + offset, p["hinge"])
        if compliant:
            for name, offset in (("inner", -p["half"]), ("outer", p["half"])):
                stiffness = place(p["x"], p["y"], p["z"])
                forces[f"{side}_{name}"] = lg.Bushing(None, wheel, at=hinge(offset), stiffness=stiffness)
        else:
            joints[f"{side}_hinge"] = lg.RevoluteJoint(None, wheel, at=hinge(0.0), axis=(0.0, 1.0, 0.0))
        low = place(p["length"] - p["spring_arm"], y, p["hinge"])
        spring = {"at_a": low, "at_b": low + place(0.0, 0.0, 0.3), "stiffness": p["spring"]}
        forces[f"{side}_spring"] = lg.SpringDamper(wheel, None, **spring)
    forces["bar"] = lg.TorsionSpringDamper("left_wheel", "right_wheel", axis=(0.0, 1.0, 0.0), stiffness=p["bar"])
    return lg.Model(bodies, joints, forces), centres


@pytest.mark.slow  # the rig against the geometry is in `test_axles`
def test_rates_and_levers_in_closed_form():
    """Rigid hinges: rates and lever ratios, anti-features from the line to the hinge."""
    vehicle = rigs.Vehicle(wheelbase=2.6, centre_height=0.5, braking_share=0.4, traction_share=1.0)
    names = ("parallel", "opposite", "braking", "traction")
    test = rigs.kc(
        *trailing_arms(ARM, compliant=False), {name: STANDARD[name] for name in names}, points=3, vehicle=vehicle
    )
    found = rigs.characteristics(test)
    a, length, track = ARM["spring_arm"], ARM["length"], ARM["track"]
    wheel_rate = ARM["spring"] * (a / length) ** 2
    lever = 2.6 / 0.5
    expected = {
        "spring_motion_ratio": a / length,
        "wheel_rate": wheel_rate,
        "roll_rate": (wheel_rate + 2 * ARM["bar"] / length**2) * track**2 / 2,
        "roll_centre_height": 0.0,
        "bump_steer": 0.0,
        "bump_recession": -(ARM["hinge"] - ARM["radius"]) / length,
        "anti_lift": 0.4 * lever * ARM["hinge"] / length,
        "anti_squat": lever * (ARM["hinge"] - ARM["radius"]) / length,
    }
    # 0.1 N/mm of 1e5: of round-off 1e-16 times the condition, some 1e4
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-8, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_compliances_in_closed_form():
    """Bushings in series and parallel: a lateral force turns the arm about z and x on its two bushings."""
    lateral = {"lateral": STANDARD["lateral"], "aligning": STANDARD["aligning"]}
    test = rigs.kc(*trailing_arms(ARM, compliant=True), lateral, points=3)
    found = rigs.characteristics(test)
    length, height, square = ARM["length"], ARM["hinge"], 2 * ARM["half"] ** 2
    yaw, roll = 1 / (ARM["x"] * square), 1 / (ARM["z"] * square)
    expected = {
        "lateral_steer": -length * yaw,
        "lateral_camber": height * roll,  # inclination to the right
        "lateral_compliance": 1 / (2 * ARM["y"]) + length**2 * yaw + height**2 * roll,
        "aligning_steer": yaw,
        "force_roll_centre_height": 0.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-8, atol=1e-12, err_msg=name)


@pytest.fixture(scope="module")
def rigid():
    names = ("parallel", "steering")
    return rigs.kc(*small_axle(compliant=False), {name: STANDARD[name] for name in names}, points=5)


@pytest.mark.slow  # `lgsens kc` asks rigs in the quick run
def test_steering_axis_is_the_line_of_the_ball_joints(rigid):
    lower, upper, centre = (np.array(POINTS[name]) for name in ("lower_ball", "upper_ball", "centre"))
    axis = upper - lower
    road = lower - axis * lower[2] / axis[2]
    expected = {
        "caster": np.arctan2(-axis[0], axis[2]),
        "kingpin_inclination": np.arctan2(-axis[1], axis[2]),
        "trail": road[0] - centre[0],
        "scrub_radius": centre[1] - road[1],
    }
    found = rigs.characteristics(rigid)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-11, err_msg=name)


PLACES = ("travel", "steer", "camber", "contact_x", "contact_y")
places = lambda test: np.stack([getattr(test.sweeps["parallel"].wheels, name) for name in PLACES])


@pytest.mark.slow
def test_rigid_axles_are_kinematics(rigid):
    """Statics of rigid joints are at the positions of `lg.kinematics`."""
    model, centres = small_axle(compliant=False)
    way = rigid.sweeps["parallel"].value
    driven = {"left_pad": way, "right_pad": way, "steering": 0.0 * way}
    motion = lg.kinematics(on_rig(model, centres), driven)
    for i, side in enumerate(SIDES):
        wheel, moved = motion.body(f"{side}_wheel"), rigid.sweeps["parallel"].wheels
        np.testing.assert_allclose(wheel.position[:, 2] - centres[side][2], moved.travel[:, i], rtol=0, atol=1e-12)
        np.testing.assert_allclose(wheel.position[:, 1] - centres[side][1], moved.centre_y[:, i], rtol=0, atol=1e-12)
        steer = np.arctan2(-wheel.orientation[:, 0, 1], wheel.orientation[:, 1, 1])
        np.testing.assert_allclose(steer, moved.steer[:, i], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_stiff_bushings_approach_rigid_joints(rigid):
    """The departure falls as 1/k, to 1e-10 m and rad under 5 kN at 1e14 N/m."""
    errors = []
    for stiffness in (1e9, 1e10, 1e14):
        p = numbers() | {"bushing": jnp.asarray(stiffness)}
        test = rigs.kc(*small_axle(p), {"parallel": STANDARD["parallel"], "steering": STANDARD["steering"]}, points=5)
        errors.append(np.abs(places(test) - places(rigid)).max())
    # The next term, 1/k², is 1e-5 of this one at 1e9 N/m.
    np.testing.assert_allclose(errors[0] / errors[1], 10.0, rtol=1e-3)
    assert errors[2] < 1e-10 < errors[1]


class Energy:
    """The small axle as its potential energy of displacements and rotation vectors, and forces by virtual work.

    Derivatives by complex steps. Unknowns: six for each of the six bodies, six for each constraint.
    """

    BODIES = tuple(f"{side}_{part}" for side in SIDES for part in ("wheel", *ARMS))

    def __init__(self):
        self.points = {s: {n: np.array(p) * sign for n, p in POINTS.items()} for s, sign in SIDES.items()}
        self.start = {}
        for side in SIDES:
            self.start[f"{side}_wheel"] = self.points[side]["centre"]
            self.start |= {f"{side}_{arm}": arm_centre(self.points[side], arm) for arm in ARMS}

    def frames(self, x):
        """By body its displaced origin and rotation, along leading axes."""
        found = {}
        for name, own in zip(self.BODIES, np.split(x, len(self.BODIES), axis=-1)):
            move, turn = own[..., :3], own[..., 3:]
            square = np.sum(turn * turn, axis=-1)[..., None, None]
            powers = [(-square) ** i for i in range(10)]
            # Σ (−θ²)ⁱ/(2i + 1)! and /(2i + 2)!: sin θ/θ and (1 − cos θ)/θ²
            sine, cosine = (
                sum(power / np.prod(np.arange(1.0, 2 * i + first + 1)) for i, power in enumerate(powers))
                for first in (1, 2)
            )
            skew = np.zeros((*turn.shape, 3), turn.dtype)
            for i, j, k, sign in ((0, 1, 2, -1), (1, 2, 0, -1), (2, 0, 1, -1)):
                skew[..., i, j] += sign * turn[..., k]
                skew[..., j, i] -= sign * turn[..., k]
            found[name] = self.start[name] + move, np.eye(3) + sine * skew + cosine * (skew @ skew), turn
        return found

    def at(self, frames, body, point):
        origin, turn, _ = frames[body]
        return origin + np.einsum("...ij,j->...i", turn, point - self.start[body])

    def energy(self, x):
        frames, total = self.frames(x), 0.0
        for name in self.BODIES:
            mass = RATES["wheel"] if name.endswith("wheel") else RATES["arm"]
            total = total + mass * 9.81 * frames[name][0][..., 2]
        for side, own in self.points.items():
            for arm, (front, rear, _) in ARMS.items():
                body = f"{side}_{arm}"
                for point in (own[front], own[rear]):
                    gap = self.at(frames, body, point) - point
                    total = total + RATES["bushing"] / 2 * np.sum(gap**2, axis=-1)
                    total = total + RATES["twist"] / 2 * np.sum(frames[body][2] ** 2, axis=-1)
            line = self.at(frames, f"{side}_lower", own["spring_arm"]) - own["spring_top"]
            longer = np.sqrt(np.sum(line**2, axis=-1)) - np.linalg.norm(own["spring_arm"] - own["spring_top"])
            total = total + RATES["preload"] * longer + RATES["spring"] / 2 * longer**2
        left, right = frames["left_lower"][1], frames["right_lower"][1]
        marker = np.einsum("...ji,...j->...i", left, -right[..., :, 2])  # of the bar, −z at first, positive to −x
        twist = np.arctan((-marker[..., 0]) / (-marker[..., 2]))
        return total + RATES["bar"] / 2 * twist**2

    def contact(self, frames, side):
        """Wheel centre, axis and contact centre."""
        centre, turn, _ = frames[f"{side}_wheel"]
        axis = turn[..., :, 1]
        up = np.array([0.0, 0.0, 1.0]) - axis[..., 2:] * axis
        return centre, axis, centre - POINTS["centre"][2] * up / np.sqrt(np.sum(up**2, axis=-1, keepdims=True))

    def constraints(self, x, case):
        frames, rows = self.frames(x), []
        for side, own in self.points.items():
            wheel = f"{side}_wheel"
            for arm, (*_, ball) in ARMS.items():
                gap = self.at(frames, f"{side}_{arm}", own[ball]) - self.at(frames, wheel, own[ball])
                rows += [gap[..., i] for i in range(3)]
            rack = own["tie_rack"] + np.array([0.0, case.get("steering", 0.0), 0.0])
            tie = self.at(frames, wheel, own["tie_wheel"]) - rack
            rows.append(np.sum(tie**2, axis=-1) - np.sum((own["tie_wheel"] - own["tie_rack"]) ** 2))
            rows.append(self.contact(frames, side)[2][..., 2] - case.get(f"{side}_pad", 0.0))
        return np.stack(rows, axis=-1)

    def loads(self, x, case, steps):
        """Virtual work of the tyres' loads along each coordinate."""
        frames, moved, work = self.frames(x), self.frames(steps), 0.0
        for side in SIDES:
            wheel = f"{side}_wheel"
            centre, axis, contact = self.contact(frames, side)
            along = np.cross(axis, [0.0, 0.0, 1.0])
            along = along / np.linalg.norm(along)
            left = np.cross([0.0, 0.0, 1.0], along)
            turn, turning = frames[wheel][1], moved[wheel][1].imag / 1e-30
            spin = turning @ turn.T
            speed = moved[wheel][0].imag / 1e-30
            force = case.get(f"{side}_lateral", 0.0) * left - case.get(f"{side}_braking", 0.0) * along
            work = work + (speed + spin @ (contact - centre)) @ force
            work = work + speed @ (case.get(f"{side}_traction", 0.0) * along)
            work = work + case.get(f"{side}_aligning", 0.0) * spin[..., 1, 0]
        return work

    def equations(self, unknowns, case):
        x, multipliers = unknowns[:36], 1e4 * unknowns[36:]
        steps = x + 1e-30j * np.eye(36)
        rows = self.constraints(steps, case).imag / 1e-30
        force = self.energy(steps).imag / 1e-30 - self.loads(x, case, steps) - rows @ multipliers
        return np.append(force / 1e4, self.constraints(x, case))

    def solve(self, case):
        """Positions of both wheels and the vertical forces of the pads."""
        found = np.zeros(52)
        for share in (0.0, 0.5, 1.0):
            part = {name: share * value for name, value in case.items()}
            found = root(self.equations, found, args=(part,), method="hybr", options={"xtol": 1e-15}).x
        assert np.abs(self.equations(found, case)).max() < 1e-12
        frames = self.frames(found[:36])
        return [(*frames[f"{side}_wheel"][:2], 1e4 * found[36 + 8 * i + 7]) for i, side in enumerate(SIDES)]


CASES = (
    {"left_pad": 0.03, "right_pad": 0.03},
    {"left_pad": -0.03, "right_pad": 0.02},
    {"steering": 0.03, "left_lateral": 1500.0, "right_lateral": 800.0},
    {"left_braking": 2500.0, "right_braking": 2000.0, "left_pad": 0.01},
    {"left_traction": 1500.0, "right_traction": 1200.0, "left_aligning": 90.0, "right_aligning": -60.0},
)


@pytest.mark.slow  # the rig's closed forms are in the quick run
def test_an_independent_static_solver_agrees():
    model, centres = small_axle()
    rig = on_rig(model, centres)
    names = sorted({name for case in CASES for name in case})
    table = {name: np.array([case.get(name, 0.0) for case in CASES]) for name in names}
    of = lambda wanted: {name: table[name] for name in names if (name in rig.joints) == wanted}
    starts = tuple(range(1, len(CASES)))
    found = lg.statics(rig, of(True), loads=of(False), starts=starts)
    solver = Energy()
    for i, case in enumerate(CASES):
        for side, (position, orientation, force) in zip(SIDES, solver.solve(case)):
            wheel = found.body(f"{side}_wheel")
            np.testing.assert_allclose(wheel.position[i], position, rtol=0, atol=1e-8)
            np.testing.assert_allclose(wheel.orientation[i], orientation, rtol=0, atol=1e-8)
            pad = -found.multiplier(f"{side}_pad")[i, 0]
            np.testing.assert_allclose(pad, force, rtol=1e-8)
    assert np.abs(found.body("left_wheel").position[0] - np.array(POINTS["centre"])).max() > 0.02  # it does move


def outputs(scene, names, points):
    """All outputs of some sweeps, zero where they are not determined."""

    def of(p):
        sweeps = rigs.kc(*scene(p), {name: STANDARD[name] for name in names}, points=points, throw=False).sweeps
        return jax.tree.map(jnp.nan_to_num, sweeps)

    return of


def check_gradients(of, p, direction):
    """Along a direction in both modes, against differences of fourth order."""
    run, h = jax.jit(of), 2e-3
    value, forward = jax.jit(lambda p, d: jax.jvp(of, (p,), (d,)))(p, direction)
    a, b, c, d = (run(jax.tree.map(lambda x, d, h=i * h: x + h * d, p, direction)) for i in (-2, -1, 1, 2))
    differences = jax.tree.map(lambda a, b, c, d: (a - 8 * b + 8 * c - d) / (12 * h), a, b, c, d)
    paths = jax.tree_util.tree_flatten_with_path(forward)[0]
    changing = 0
    for (path, found), expected, own in zip(paths, jax.tree.leaves(differences), jax.tree.leaves(value)):
        # Round-off of an output, 1e-11 of its size for the condition of 1e5, over h; numbers change by 2e-4 of theirs.
        size = max(np.abs(own).max(), np.abs(expected).max())
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * size + 1e-13, err_msg=name)
        changing += np.abs(expected).max() > 1e-6 * size > 1e-13
    assert changing > 0.4 * len(paths)
    rng = np.random.default_rng(1)
    # Outputs that are zero by symmetry have round-off for derivatives, 1e-16, and no weight to make it large.
    size = jax.tree.map(lambda x: jnp.abs(x).max(), value)
    weights = jax.tree.map(
        lambda x, s: jnp.asarray(rng.normal(size=x.shape)) * jnp.where(s > 1e-8, 1.0 / jnp.maximum(s, 1e-8), 0.0),
        value,
        size,
    )
    back = jax.jit(lambda p: jax.vjp(of, p)[1](weights)[0])(p)
    inner = lambda one, other: float(sum(map(jnp.vdot, jax.tree.leaves(one), jax.tree.leaves(other))))
    # one linear operator and its transpose
    np.testing.assert_allclose(inner(back, direction), inner(weights, forward), rtol=1e-9)


def relative_direction(p, seed=0):
    """Changes of about a per cent of each number."""
    rng = np.random.default_rng(seed)
    size = lambda x: 0.1 * jnp.maximum(jnp.abs(x), 0.1)
    return {name: size(x) * jnp.asarray(rng.uniform(-1, 1, np.shape(x))) for name, x in p.items()}


@pytest.mark.slow
def test_gradients_of_trailing_arms():
    p = {name: jnp.asarray(value, float) for name, value in ARM.items()}
    names = ("parallel", "opposite", "lateral", "braking", "traction")
    check_gradients(outputs(lambda p: trailing_arms(p, compliant=True), names, 3), p, relative_direction(p))


@pytest.mark.slow
def test_gradients_of_every_output():
    """All sweeps of an axle that steers, by all of its numbers."""
    p = numbers()
    check_gradients(outputs(small_axle, tuple(STANDARD), 3), p, relative_direction(p))


def test_bad_input():
    model, centres = trailing_arms(ARM, compliant=False)
    with pytest.raises(ValueError, match=says("`points` must be odd", "got 4")):
        rigs.kc(model, centres, points=4)
    with pytest.raises(ValueError, match=says("['steering'] are not among", "has no rack")):
        rigs.kc(model, centres, {"steer": Sweep(0.01, {"steering": 1.0})})
    with pytest.raises(ValueError, match=says("`sweeps['low'].amplitude` must be positive, got -1.0")):
        rigs.kc(model, centres, {"low": Sweep(-1.0, {"left_pad": 1.0})})
    with pytest.raises(ValueError, match=says("`centres`", "['right'] are missing")):
        rigs.kc(model, {"left": centres["left"]})
    bodies = {"left_wheel": model.bodies["left_wheel"]}
    with pytest.raises(ValueError, match=says("needs the body 'right_wheel'", "['left_wheel']")):
        on_rig(lg.Model(bodies), centres)
