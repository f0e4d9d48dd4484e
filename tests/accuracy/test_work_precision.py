"""The dial on a scene in closed form: what the table says is so, and failures are rows."""

import json

import diffrax
import numpy as np
import pytest
from oscillator import CRITERION, T1, P, build, exact_with_gradient

import lgsens as lg
from lgsens import accuracy
from lgsens.accuracy import Setting, grid, recommend, work_precision

DOPRI8 = lg.IndexReducedODE(diffrax.Dopri8())
IMPATIENT = lg.GeneralizedAlpha(max_iterations=1, factor_every=0)
SETTINGS = (
    *grid((20, 40)),
    Setting(20, extrapolate=True),
    Setting(10, DOPRI8),
    Setting(40, model={"damping": 0.5}, name="damped"),
    Setting(20, IMPATIENT, name="impatient"),
    Setting(20, DOPRI8, options={"sensitivity": lg.AdjointVariable()}, name="forbidden"),
)


@pytest.fixture(scope="module")
def table():
    return work_precision(CRITERION, build, P, SETTINGS, t1=T1, progress=False)


def test_the_reference_knows_its_error(table):
    """Against the closed form; and as good as order 8 on a sine must be."""
    value, gradient = exact_with_gradient()
    reference = table.reference
    assert reference.error < 1e-9 and reference.confirmed
    assert abs(reference.value / value - 1) <= reference.value_error
    assert np.abs(reference.gradient - gradient).max() / np.abs(gradient).max() <= reference.gradient_error
    assert len(reference.evidence) == 2


def test_errors_are_those_of_the_closed_form(table):
    """Up to the error of the reference, and round-off."""
    value, gradient = exact_with_gradient()
    for row in table.rows[:4]:
        assert not row.failure
        assert row.value == pytest.approx(value * (1 + np.sign(row.value - value) * row.value_error), rel=2e-9)
        actual = np.abs(row.gradient - gradient).max() / np.abs(gradient).max()
        assert row.gradient_error == pytest.approx(actual, abs=2e-9)
    coarse, fine, extrapolated, explicit = table.rows[:4]
    # ωh = 0.22 and 0.11: the next order is (ωh)² of the leading one, and h³ has a small coefficient at ρ∞ = 0.9
    assert coarse.error / fine.error == pytest.approx(4.0, rel=0.1)
    assert extrapolated.error < 0.1 * fine.error  # that of 40 steps is what extrapolation improves
    assert explicit.error < 1e-4 * fine.error


def test_what_else_a_row_says(table):
    coarse, fine, extrapolated, explicit, damped, impatient, forbidden = table.rows
    for row in (coarse, fine, extrapolated, explicit, damped):
        assert row.seconds > 0 and row.cpu_seconds > 0 and row.compile_seconds > 0 and row.unfinished == 0
        assert row.temporary_bytes is None or row.temporary_bytes > 0
        assert row.violation == 0.0  # no joint
        assert row.iterations >= 1
    # Energy: of second order by the scheme; (ωh)⁹ = 7e-4⁹ … by the stages; work of the damper included
    assert coarse.energy_drift / fine.energy_drift == pytest.approx(4.0, rel=0.15)
    assert explicit.energy_drift < 1e-6 * fine.energy_drift
    assert damped.energy_drift < 3 * fine.energy_drift
    # another model is another criterion: v²t/4·(damping t/m) or so
    assert 0.05 < damped.value_error < 0.5
    assert impatient.failure and "Newton" in impatient.failure and impatient.unfinished == 20
    assert forbidden.failure.startswith("ValueError: `sensitivity`")


def test_recommendations(table):
    explicit = table.rows[3]
    fastest = min((row for row in table if row.error <= 0.05), key=lambda row: row.seconds)
    assert recommend(table, 0.05).row is fastest
    best = recommend(table, 2 * explicit.error + table.reference.error)
    assert best.row is explicit and best.setting is SETTINGS[3] and best.margin > 1
    assert str(explicit.setting.num_steps) in str(best) and best
    none = recommend(table, 1e-13)
    assert not none and none.row is None and "reference itself" in str(none)
    with pytest.raises(ValueError, match="reference itself"):
        _ = none.setting
    assert recommend(table, 0.05, by="cpu_seconds")


def test_the_recommended_setting_is_used_as_it_is(table):
    value, _ = exact_with_gradient()
    setting = recommend(table, 1e-8).setting
    assert setting.evaluate(CRITERION, build, P, t1=T1) == pytest.approx(value, rel=1e-8)
    assert setting.trajectory(build, P, t1=T1).t.shape == (setting.num_steps + 1,)


def test_text_and_json(table, tmp_path):
    text = str(table)
    assert "impatient" in text and "failed: Newton" in text and "reference: Ψ" in text
    document = json.loads(json.dumps(table.document(), allow_nan=False))
    assert [row["num_steps"] for row in document["rows"]] == [setting.num_steps for setting in SETTINGS]
    assert document["rows"][5]["value"] is None and document["rows"][5]["failure"]
    assert document["rows"][0]["gradient_error"] == table.rows[0].gradient_error
    figure = accuracy.plot(table, (1e-2, 1e-30), title="oscillator")
    left, right = figure.axes
    assert left.get_ylabel() == "relative error of Ψ [–]" and right.get_ylabel() == "relative error of dΨ/dp [–]"
    names = {line.get_label() for line in left.lines if not line.get_label().startswith("_")}
    assert names == {row.setting.curve for row in table if not row.failure}
    assert [note.get_text() for note in left.texts] == ["0.01"]  # nothing meets the other target
    assert lg.plotting.save(figure, tmp_path / "a.png").stat().st_size > 10_000  # an empty canvas has some 3 kB


def test_a_function_of_the_trajectory_is_enough():
    """The reference is what the function gives in the limit, its own rule included, and says how well it knows it."""
    fn = lambda trajectory: lg.time_integral(trajectory.t, (trajectory.body("mass").position[:, 2] - 1.0) ** 2)
    found = work_precision(fn, build, P, [Setting(40)], t1=T1, progress=False)
    value, _ = exact_with_gradient()
    assert abs(found.reference.value / value - 1) <= found.reference.value_error
    assert found.rows[0].value == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": []}, "`settings` must be values of Setting"),
        ({"settings": [20]}, "`settings` must be values of Setting"),
        ({"rounds": 3}, "`rounds` must be at least 5, got 3"),
        ({"fn": 3.0}, "`fn` must be a function"),
        ({"p": {}}, "`p` has no arrays"),
        ({"scale": {"k": 0.0, "m": 1.0}}, "`scale` must be positive"),
        ({"scale": {"k": 1.0}}, "`scale` must be a pytree as `p`"),
        ({"reference": accuracy.Reference(1.0, np.zeros(3), 0.0, 0.0)}, r"gradient must have shape \(2,\), got \(3,\)"),
    ],
)
def test_bad_input(change, message):
    arguments = {"fn": CRITERION, "build": build, "p": P, "settings": SETTINGS, "t1": T1, "progress": False} | change
    with pytest.raises(ValueError, match=message):
        work_precision(**arguments)


def test_a_function_that_never_works_is_said_at_once():
    with pytest.raises(ValueError, match=r"finds no reference.*no_such_body"):
        work_precision(lambda t: t.body("no_such_body").position[-1, 0], build, P, t1=T1, progress=False)


def test_settings():
    setting = Setting(20, lg.GeneralizedAlpha(0.5, tolerance=1e-5), model={"links": "rods"})
    assert setting == Setting(20, lg.GeneralizedAlpha(0.5, tolerance=1e-5), model={"links": "rods"})
    assert hash(setting) != hash(Setting(21, setting.integrator, model=setting.model))
    assert setting.label == "GeneralizedAlpha(rho_inf=0.5, tolerance=1e-05), links='rods'"
    assert setting.curve == "GeneralizedAlpha, links='rods'"
    assert Setting(5, DOPRI8, extrapolate=True).label == "extrapolated IndexReducedODE(solver=Dopri8())"
    assert Setting(5, lg.Richardson()).label == "Richardson()"
    assert (Setting(5, DOPRI8, name="a").label, Setting(5, DOPRI8, family="b").curve) == ("a", "b")
    assert len(set(accuracy.ladder())) == len(accuracy.ladder()) == 17
    assert {setting.num_steps for setting in accuracy.ladder(10)} == {5, 10, 20, 40, 80, 160, 640}
    with pytest.raises(ValueError, match="`num_steps` must be at least 1"):
        Setting(0)
    with pytest.raises(ValueError, match="options must be a dict"):
        Setting(5, model=3)
