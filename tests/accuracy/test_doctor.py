"""`doctor` names the extreme that a scene comes near to, with a number known otherwise, and no other."""

import numpy as np
import pytest

import lgsens as lg
from lgsens.accuracy import doctor
from lgsens.accuracy._doctor import of_numbers
from lgsens.cli._doctor import read
from lgsens.cli._main import main

FILE = """
import lgsens as lg


def build(p):
    spring = lg.SpringDamper(None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1), stiffness=p, free_length=1.0)
    body = lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0, 0, 1), velocity=(0, 0, 0.3), free="z")
    return lg.Model({"mass": body}, {}, {"spring": spring})


criterion = lambda trajectory: trajectory.body("mass").position[-1, 2]
parameters = 40.0
t1 = 1.0
"""


def pendulum(*, mass=1.0, inertia=(0.1, 0.1, 0.1), gravity=9.81, stiffness=None):
    body = lg.RigidBody(mass, inertia, position=(1.0, 0.0, 0.0))
    forces = {"gravity": lg.Gravity((0.0, 0.0, -gravity))}
    joints = {"pivot": lg.RevoluteJoint(None, "bob", at=(0, 0, 0), axis=(0, 1, 0))}
    if stiffness is not None:
        forces["spring"] = lg.TorsionSpringDamper(None, "bob", axis=(0, 1, 0), stiffness=stiffness)
    return lg.Model({"bob": body}, joints, forces)


@pytest.mark.slow  # three scenes
def test_a_stiff_spring_and_a_spin_are_told_by_their_numbers():
    """ω = √(k/(J + m l²)) at the hinge, of a pendulum that starts level and at rest, where gravity has no stiffness.

    A ball that nothing holds keeps its spin.
    """
    found = {each.extreme: each for each in doctor(pendulum(stiffness=1.1e6), t1=0.2, num_steps=20).near}
    fastest = found["fastest mode at the start times the step, |λ| h"]
    np.testing.assert_allclose(fastest.number, 1e3 * 0.01, rtol=1e-6)  # round-off of λ² beside λ = 0: √ε at most
    assert "take smaller steps" in fastest.remedy
    ball = lg.Model({"ball": lg.RigidBody(1.0, (0.1, 0.1, 0.1), angular_velocity=(0.0, 60.0, 0.0))}, {}, {})
    found = {each.extreme: each for each in doctor(ball, t1=0.2, num_steps=20).near}
    np.testing.assert_allclose(found["largest rotation in a step [rad]"].number, 0.6, rtol=1e-9)


@pytest.mark.parametrize(
    "changes, extreme, number",
    [
        ({"gravity": 9810.0}, "gravity [m/s²]", 9810.0),
        ({"inertia": (1e5, 1e5, 1e5)}, "largest radius of gyration over the scene's length", np.sqrt(1e5)),
        ({"inertia": (1e-12, 0.1, 0.1)}, "least radius of gyration over the scene's length", 1e-6),
    ],
)
def test_numbers_that_look_like_other_units_or_nothing(changes, extreme, number):
    """Of a bob of 1 kg at 1 m, the length of its scene."""
    found = {each.extreme: each for each in of_numbers(pendulum(**changes)) if each.near}
    assert list(found) == [extreme]
    np.testing.assert_allclose(found[extreme].number, number, rtol=1e-6)


def test_a_scene_runs_from_its_own_begin(tmp_path):
    (tmp_path / "mine.py").write_text(f"{FILE}t0 = 0.25\n", encoding="utf-8")
    model, *times = read(str(tmp_path / "mine.py"))
    assert isinstance(model, lg.Model) and times == [0.25, 0.75]


def test_command(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(FILE, encoding="utf-8")
    assert main(["doctor", str(tmp_path / "mine.py"), "--dt", "0.01", "--quiet"]) == 0
    assert "Nothing extreme." in capsys.readouterr().out
    assert main(["doctor", "nowhere.toml"]) == 2
    assert "neither a file nor one of" in capsys.readouterr().err
    with pytest.raises(ValueError, match="`model` must be a Model"):
        doctor(3, t1=1.0, num_steps=10)
