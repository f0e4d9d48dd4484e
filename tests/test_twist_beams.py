"""The twist-beam axle: its stiffness and angles in roll against closed forms, open sections, and its file."""

import dataclasses
import tomllib
from importlib import resources

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import some_quick

import lgsens as lg
from lgsens import rigs
from lgsens.examples import Axle
from lgsens.examples._axle_numbers import places

FILE = resources.files("lgsens.examples") / "data" / "twist_beam.toml"
AXLE = Axle.load("twist_beam")


def numbers():
    """What decides how the axle rolls."""
    member = AXLE.twist_beam
    return {
        "torsion": member.beam.of.stiffness[3],
        "pivot": AXLE.left.joints["pivot"].at,
        "end": member.end,
        "shear_centre": member.shear_centre,
    }


def axle_of(p):
    where = lambda axle: (
        axle.twist_beam.beam.of.stiffness,
        axle.left.joints["pivot"].at,
        axle.twist_beam.ends["knuckle"],
        axle.twist_beam.shear_centre,
    )
    stiffness = (p.get("stiffer", 1.0) * AXLE.twist_beam.beam.of.stiffness).at[3].set(p["torsion"])
    return eqx.tree_at(where, AXLE, (stiffness, p["pivot"], p["end"], p["shear_centre"]))


def closed(p):
    """Of the wheel that goes up by z, the other one by −z, to first order: inclination and steer angle per z, left; and
    the roll stiffness."""
    (x, b, z), (end_x, half_length, end_z), (forward, up) = p["pivot"], p["end"], p["shear_centre"]
    wheel_x, t, _ = AXLE.left.wheel.centre
    c, h = x - end_x - forward, end_z + up - z
    s = b * (x - wheel_x) + c * (t - b)
    return c / s, -h / s, p["torsion"] / (2 * half_length) * (2 * b * t / s) ** 2


def one_element(beam):
    """In either half, which twists as uniformly."""
    return dataclasses.replace(beam, elements=1)


def rolled(p, compliant):
    """The same from forces: the right wheel held, the left one pushed up by 1 N, so that it goes up by 2 z."""
    axle = axle_of(p)
    member = eqx.tree_at(lambda member: member.beam, axle.twist_beam, replace_fn=one_element)
    cars = {"left": axle.left, "right": axle.right}
    bodies = {f"{side}_knuckle": car.knuckle.body() for side, car in cars.items()}
    at = {side: car.joints["pivot"].at for side, car in cars.items()}
    joints = {side: lg.SphericalJoint(None, f"{side}_knuckle", at=place) for side, place in at.items()}
    centre, up = axle.wheel_centres["right"], jnp.array([0.0, 0.0, 1.0])
    joints["held"] = lg.DistanceJoint(None, "right_knuckle", at_a=centre + up, at_b=centre)
    more = member.scene(cars, compliant)
    system = lg.Model(bodies | more.bodies, joints | more.joints, more.forces).system()
    q, v = system.reference()
    none, start = jnp.zeros(len(system.constraint_names)), jnp.zeros(())
    stiffness, _, jacobian = system.tangents(q, v, v, none, start)
    matrix = jnp.block([[stiffness, jacobian.T], [jacobian, jnp.zeros((none.size, none.size))]])
    i, arm = system.body_names.index("left_knuckle"), axle.left.wheel.centre - axle.left.knuckle.centre
    push = jnp.zeros((v.size // 6, 6)).at[i].set(jnp.concatenate([up, jnp.cross(arm, up)]))
    moved = jnp.linalg.solve(matrix, jnp.concatenate([push.ravel(), none]))[6 * i : 6 * i + 6]
    travel = (moved[:3] + jnp.cross(moved[3:], arm))[2]
    # F 2z = K φ², φ = z/t
    return *(2 * moved[jnp.array([3, 5])] / travel), 4 * axle.left.wheel.centre[1] ** 2 / travel


@pytest.mark.parametrize(
    ("compliant", "by_numbers"),
    some_quick([(False, True), (True, False), (True, True)]),  # of beams: `test_axles.py` has their forces in balance
)
def test_it_rolls_as_closed_forms_say(compliant, by_numbers):
    """On ball joints, of a beam and of halves, derivatives by G J, both hardpoints and the shear centre too. The shear
    centre stays where it is but for the force that it takes there, which bends the beam: by 1/EI, 0.4 % of the car's
    camber, and so much less of one that is 1000 times stiffer in all but torsion."""
    p = numbers()

    @jax.jit
    def both(p, stiffer):
        found = lambda p: jnp.stack(rolled(p | {"stiffer": stiffer}, compliant))
        wanted = lambda p: jnp.stack(closed(p))
        return [(of(p), jax.jacfwd(of)(p) if by_numbers else {}) for of in (found, wanted)]

    (soft, _), _ = both(p, jnp.ones(()))
    (found, slopes), (wanted, by) = both(p, jnp.asarray(1e3))
    assert float(wanted[2]) == pytest.approx(11.8e3, rel=0.01)  # N m/rad
    # and of linear equations from 1e11 N/m of shear to 1e3 N m of twist
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    np.testing.assert_allclose(soft, wanted, rtol=5e-3)
    if compliant:
        np.testing.assert_allclose((soft - wanted) / (found - wanted), 1e3, rtol=0.02)
    assert bool(by) == by_numbers
    for key, slope in by.items():
        scale = np.abs(wanted).reshape(3, *[1] * (slope.ndim - 1)) / (1e3 if key == "torsion" else 0.5)
        np.testing.assert_allclose(slopes[key] / scale, slope / scale, rtol=0, atol=2e-5, err_msg=key)


def test_an_open_section_twists_about_its_shear_centre():
    """Forces there twist nothing, those at the centroid by their moment about it over G J."""
    K = [2.5e8, 4e7, 3e7, 1.2e3, 1e5, 4e5]
    s = np.array([0.01, -0.03])
    softness = np.linalg.inv(lg.BeamSection(K, 9.0, (0.02, 0.01, 0.01)).sheared_at(s).matrix)
    for q in np.eye(2):
        about = s[0] * q[1] - s[1] * q[0]  # e₁ · (s × q)
        strain = softness @ np.array([0.0, *q, about, 0.0, 0.0])
        np.testing.assert_allclose(strain[3], 0.0, atol=1e-15)
        np.testing.assert_allclose(strain[1:3], q / np.array(K[1:3]), rtol=1e-9, atol=1e-20)
        assert (softness @ np.array([0.0, *q, 0.0, 0.0, 0.0]))[3] == pytest.approx(-about / K[3], rel=1e-9)
    assert 1 / softness[3, 3] == pytest.approx(K[3], rel=1e-9)
    with pytest.raises(ValueError, match=r"`centre` must have shape \(2,\)"):
        lg.BeamSection(K, 9.0, (0.02, 0.01, 0.01)).sheared_at([0.0, 0.0, 0.03])


def test_the_section_of_the_file():
    """A V of sheet: area and moments of area by sums over its middle line, E and G of steel; three digits."""
    file = tomllib.loads(FILE.read_text(encoding="utf-8"))["twist_beam"]
    section, leg, s, E, G, rho = file["beam"]["section"], 0.1, 0.006, 2.1e11, 8.08e10, 7850.0
    along = (np.arange(1000) + 0.5) * leg / 1000 / np.sqrt(2)  # from the edge, forward and down
    x, z = np.concatenate([along, -along]), -np.concatenate([along, along])
    area, polar = 2 * leg * s, 2 * leg * s**3 / 3
    across, opening = area * np.var(z), area * np.mean(x**2)
    shear = 5 / 12 * G * area
    wanted = [E * area, shear, shear, G * polar, E * across, E * opening]
    np.testing.assert_allclose(section["stiffness"], wanted, rtol=5e-3)
    np.testing.assert_allclose(section["mass"], rho * area, rtol=1e-3)
    np.testing.assert_allclose(section["inertia"], rho * np.array([across + opening, across, opening]), rtol=1e-2)
    np.testing.assert_allclose(file["shear_centre"], [0.0, -np.mean(z)], atol=1e-4)
    assert section["stiffness"][3] / G < 0.01 * (across + opening)  # soft in torsion


def test_masses_and_numbers_of_a_twist_beam():
    member = AXLE.twist_beam
    offered = {kind: {place.name for place in of} for kind, of in places(AXLE).items()}
    assert "twist_beam.beam.section.stiffness.4" in offered["rates"] and "twist_beam.knuckle.z" in offered["hardpoints"]
    assert float(member.own_mass) == pytest.approx(9.42 * 1.0, rel=1e-12)
    assert float(AXLE.mass) == pytest.approx(2 * float(AXLE.left.mass) + 9.42, rel=1e-12)
    assert float(member.rate) == pytest.approx(1163.0, rel=1e-12)
    whole = sum(float(body.mass) for body in member.bent().bodies.values())
    half = sum(float(body.mass) for body in member.bent(half=True).bodies.values())
    np.testing.assert_allclose([whole, half], [9.42, 4.71], rtol=1e-12)
    tube = dataclasses.replace(member, shear_centre=None)
    assert float(tube.rate) == pytest.approx(1163.0, rel=1e-12)


def outputs(p):
    """On the rig, on bushings."""
    axle = axle_of(p)
    sweeps = {name: rigs.standard_sweeps()[name] for name in ("opposite", "lateral")}
    test = rigs.kc(axle.model(), axle.wheel_centres, sweeps, points=3, throw=False)
    found = rigs.characteristics(test)
    roll = test.sweeps["opposite"].roll_rate[1]
    return jnp.stack([found[name] for name in ("roll_steer", "roll_camber", "lateral_steer")] + [roll])


@pytest.mark.slow  # the axle on the rig
def test_its_roll_centre_is_that_of_the_forces():
    """Paths of both contact centres, each by either pad, and vertical by lateral forces: reciprocity, which holds of
    springs and bushings too."""
    sweeps = {name: rigs.standard_sweeps()[name] for name in ("parallel", "lateral")}
    of = rigs.characteristics(rigs.kc(AXLE.model(), AXLE.wheel_centres, sweeps, points=3))
    assert abs(float(of["force_roll_centre_height"])) > 0.05
    # linear equations from 1e3 to 1e9 N/m
    assert float(of["roll_centre_height"]) == pytest.approx(float(of["force_roll_centre_height"]), rel=1e-7)


@pytest.mark.slow  # the axle on the rig, and its derivatives
def test_on_the_rig():
    """Roll steer and camber are those of stiff bushings to what these yield; derivatives by G J and along a random
    direction of both hardpoints are differences."""
    p = numbers()
    compiled = jax.jit(outputs)
    found, slopes = np.asarray(compiled(p)), jax.jit(jax.jacfwd(outputs))(p)
    inclination, steer, _ = closed(p)
    t = float(AXLE.left.wheel.centre[1])
    # bushings of 3e6 N/m beside wheel rates of 4e4 N/m, and of 0.8e6 N/m along their axes
    assert found[0] == pytest.approx(-float(steer) * t, rel=0.08)
    assert found[1] == pytest.approx(-float(inclination) * t, rel=0.03)
    rng = np.random.default_rng(0)
    along = {"torsion": 1000.0, "pivot": rng.normal(size=3), "end": rng.normal(size=3), "shear_centre": np.zeros(2)}
    for keys in (("torsion",), ("pivot", "end")):
        moved = lambda h, keys=keys: compiled(p | {key: p[key] + h * along[key] for key in keys})
        a, b, c, d = (np.asarray(moved(i * 1e-3)) for i in (-2, -1, 1, 2))
        wanted = (a - 8 * b + 8 * c - d) / 12e-3
        slope = sum(np.tensordot(slopes[key], along[key], np.ndim(along[key])) for key in keys)
        scale = np.abs(found) / (1.0 if keys == ("torsion",) else 0.3) + np.abs(wanted)
        # equilibria to 1e-10 or so over h = 1e-3, and h⁴ f⁽⁵⁾/30
        np.testing.assert_allclose(slope / scale, wanted / scale, rtol=0, atol=1e-6)


@pytest.mark.slow  # two scenes
@pytest.mark.parametrize("compliant", [True, False])
def test_half_of_it_moves_as_all_of_it(compliant):
    """Over a bump that both wheels meet: half of the beam, whose middle stays upright to the plane of symmetry."""
    whole = AXLE.model(chassis="guided", tyres=True, compliant=compliant)
    road = lg.BumpRoad(height=AXLE.left.bump_height, duration=AXLE.left.bump_duration)
    meets = lambda name, force: dataclasses.replace(force, road=road) if name.endswith("_tyre") else force
    whole = lg.Model(whole.bodies, whole.joints, {name: meets(name, force) for name, force in whole.forces.items()})
    half = AXLE.half(links="bodies", compliant=compliant)
    runs = [lg.simulate(model, t1=0.1, num_steps=50) for model in (half, whole)]
    for body in ("chassis", "left_wheel", "left_knuckle"):
        found, expected = (run.body(body).acceleration[:, 2] for run in runs)
        # positions to 1e-16 over βh² = 1e-6, forces of 1e8 N/m of the beam's ends on masses of 1 kg
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
