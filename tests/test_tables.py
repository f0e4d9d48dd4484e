"""A motion as tables: `to_csv` read back by Python's csv, `to_xarray` and `to_pandas` by their own packages."""

import copy
import csv
import pickle
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg

Y = (0.0, 1.0, 0.0)


def model(**options):
    """A driven arm with a weld, a plain motor and a state."""
    spin = {"velocity": (0.0, 0.0, -1.0), "angular_velocity": (0.0, 2.0, 0.0)}
    bodies = {
        "arm": lg.RigidBody(2.0, (0.02, 0.3, 0.3), position=(0.5, 0.0, 0.0), **spin),
        "ball": lg.RigidBody(1.0, (0.05, 0.04, 0.03), position=(1.0, 0.0, 0.0), **spin),
    }
    joints = {"hinge": lg.RevoluteJoint(None, "arm", at=(0, 0, 0), axis=Y), "weld": lg.FixedJoint("arm", "ball", at=Y)}
    motor = lg.Actuator(lg.RotationDriver(None, "arm", axis=Y), command=3.0, time_constant=0.1)
    return lg.Model(bodies, joints, {"motor": motor}, **options)


@pytest.fixture(scope="module")
def trajectory():
    return lg.simulate(model(merge_fixed=True), t1=0.1, num_steps=4)


def expected(trajectory):
    """Some of the columns, by the methods of the trajectory."""
    hinge, arm = trajectory.joint("hinge"), trajectory.body("arm")
    return {
        "time [s]": trajectory.t,
        "arm.position.z [m]": arm.position[:, 2],
        "arm.orientation.x.z [1]": arm.orientation[:, 0, 2],
        "ball.angular_velocity.y [rad/s]": trajectory.body("ball").angular_velocity[:, 1],
        "ball.acceleration.x [m/s²]": trajectory.body("ball").acceleration[:, 0],
        "hinge.angle [rad]": hinge.angle,
        "hinge.angle_rate [rad/s]": hinge.rate,
        "hinge.angle_acceleration [rad/s²]": hinge.acceleration,
        "hinge.force.x [N]": hinge.force[:, 0],
        "weld.moment.y [N m]": trajectory.joint("weld").moment[:, 1],
        "hinge.multiplier.3": trajectory.multiplier("hinge")[:, 2],
        "weld.multiplier.6": trajectory.multiplier("weld")[:, 5],
        "motor.output": trajectory.states_of("motor")["output"],
    }


def test_csv_has_everything_in_full_precision(trajectory, tmp_path):
    trajectory.to_csv(tmp_path / "run.csv")
    with open(tmp_path / "run.csv", newline="", encoding="utf-8") as file:
        heads, *rows = csv.reader(file)
    table = dict(zip(heads, np.array(rows, float).T))
    bodies, joints = 2 * (4 * 3 + 3 + 9), (3 + 6 + 5) + (6 + 6)
    assert len(heads) == len(set(heads)) == 1 + bodies + joints + 1
    for name, values in expected(trajectory).items():
        np.testing.assert_array_equal(table[name], values, err_msg=name)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda run: pickle.loads(pickle.dumps(run))], ids=["copy", "pickle"])
def test_copies_know_what_the_run_knows(trajectory, copied):
    for (name, column), other in zip(expected(trajectory).items(), expected(copied(trajectory)).values(), strict=True):
        np.testing.assert_array_equal(other, column, err_msg=name)


def test_xarray(trajectory):
    pytest.importorskip("xarray")
    found = trajectory.to_xarray()
    assert dict(found.sizes) == {"time": 5, "axis": 3, "body_axis": 3, "hinge_equation": 5, "weld_equation": 6}
    np.testing.assert_array_equal(found.time, trajectory.t)
    np.testing.assert_array_equal(found["arm.orientation"], trajectory.body("arm").orientation)
    np.testing.assert_array_equal(found["hinge.force"].sel(axis="z"), trajectory.joint("hinge").force[:, 2])
    np.testing.assert_array_equal(found["weld.multiplier"].sel(weld_equation="2"), trajectory.multiplier("weld")[:, 1])
    units = {
        name: found[name].attrs.get("units") for name in ("time", "arm.velocity", "hinge.angle_rate", "weld.moment")
    }
    assert units == {"time": "s", "arm.velocity": "m/s", "hinge.angle_rate": "rad/s", "weld.moment": "N m"}
    assert "units" not in found["motor.output"].attrs and found.attrs == {"result": "successful"}


def test_pandas(trajectory):
    pytest.importorskip("pandas")
    found = trajectory.to_pandas()
    np.testing.assert_array_equal(found.index, trajectory.t)
    units = found.attrs["units"]
    for head, values in expected(trajectory).items():
        name, _, unit = head.partition(" [")
        assert units[name] == (unit.rstrip("]") or None)
        if name != "time":
            np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_messages(trajectory, monkeypatch, tmp_path):
    for module, method in (("xarray", "to_xarray"), ("pandas", "to_pandas")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match=says(f"`{method}` needs {module}", 'pip install "lgsens[data]"')):
            getattr(trajectory, method)()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), trajectory)
    with pytest.raises(ValueError, match=says("`to_csv`", "batch of motions, of shape (2,)", "leaf[i]")):
        batch.to_csv(tmp_path / "run.csv")
    with pytest.raises(ValueError, match=says("`to_csv`", "is traced", "return it from `jit`")):
        jax.jit(lambda run: run.to_csv(tmp_path / "run.csv"))(trajectory)
    assert not (tmp_path / "run.csv").exists()
