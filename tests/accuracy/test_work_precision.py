"""The dial on a scene in closed form: what the table says is so, and failures are rows."""

import dataclasses
import json

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from oscillator import CRITERION, T1, P, V, build, exact_with_gradient

import lgsens as lg
from lgsens import accuracy
from lgsens.accuracy import Setting, grid, recommend, work_precision

DOPRI8 = lg.IndexReducedODE(diffrax.Dopri8())
IMPATIENT = lg.GeneralizedAlpha(max_iterations=1, factor_every=0)
SETTINGS = (
    *grid((20, 40)),
    Setting(10, DOPRI8),
    Setting(20, IMPATIENT, name="impatient"),
    Setting(20, DOPRI8, options={"sensitivity": "none"}, name="forbidden"),
)


@pytest.fixture(scope="module")
def table():
    value, gradient = exact_with_gradient()
    reference = accuracy.Reference(value, gradient, 1e-13, 1e-13)
    return work_precision(CRITERION, build, P, SETTINGS, t1=T1, reference=reference, progress=False)


@pytest.mark.slow  # eight programs
def test_the_reference_knows_its_error():
    """Against the closed form; and a model with a damper is a row of its own, off by what the damper does."""
    settings = [
        Setting(10, DOPRI8, model={"damping": 0.5}),
        Setting(20, extrapolate=True),
        Setting(20, extrapolate=3),
    ]
    found = work_precision(CRITERION, build, P, settings, t1=T1, progress=False)
    value, gradient = exact_with_gradient()
    reference, (row, extrapolated, twice) = found.reference, found.rows
    assert reference.error < 1e-9 and reference.confirmed and len(reference.evidence) == 2
    assert abs(reference.value / value - 1) <= reference.value_error
    assert np.abs(reference.gradient - gradient).max() / np.abs(gradient).max() <= reference.gradient_error
    # z falls as exp(−ct/2m), Ψ about as its square in the mean: 1 − exp(−ct/m) over t is 0.12
    assert row.value_error == pytest.approx(0.12, rel=0.3) and not row.failure
    assert row.energy_drift < 1e-6  # the work of the damper is counted
    assert 0 < extrapolated.error < 1e-4  # (ωh)⁴/100 for ωh = 0.22, where 40 steps alone have (ωh)²/50
    assert 0 < twice.error < 0.1 * extrapolated.error  # another (ωh)²


@pytest.mark.slow  # `test_values_and_gradients_are_those_of_the_closed_form` is in the quick run
def test_errors_are_those_of_the_closed_form(table):
    value, gradient = exact_with_gradient()
    coarse, fine, explicit = rows = table.rows[:3]
    for row in rows:
        assert not row.failure
        assert row.value_error == pytest.approx(abs(row.value / value - 1), abs=1e-15)
        actual = np.abs(row.gradient - gradient).max() / np.abs(gradient).max()
        assert row.gradient_error == pytest.approx(actual, abs=1e-15)
    # ωh = 0.22 and 0.11: the next order is (ωh)² of the leading one, and h³ has a small coefficient at ρ∞ = 0.9
    assert coarse.error / fine.error == pytest.approx(4.0, rel=0.1)
    assert explicit.error < 1e-4 * fine.error


@pytest.mark.slow
def test_settings_that_differ_in_numbers_share_their_programs(table, compiled):
    """Other steps, tolerances and damping, extrapolated or not: what the table has compiled serves them."""
    loose = lg.GeneralizedAlpha(0.7, tolerance=1e-6)
    settings = *grid((25, 50), loose), Setting(15, extrapolate=3), Setting(12, DOPRI8)
    measure = lambda: (
        work_precision(CRITERION, build, P, settings, t1=T1, reference=table.reference, progress=False).rows
    )
    names, rows = compiled(measure)
    assert all(not row.failure and row.error < 0.1 for row in rows)
    assert not {"_scene", "_motion", "_pulled_to_scene", "_pulled_to_p"} & set(names)
    assert names.count("_values") == 6  # for each number of steps: 25, 50, 15, 30, 60, 12


def test_what_else_a_row_says(table):
    coarse, fine, explicit, impatient, forbidden = table.rows
    for row in (coarse, fine, explicit):
        assert row.seconds > 0 and row.cpu_seconds > 0 and row.compile_seconds > 0 and row.unfinished == 0
        assert row.temporary_bytes is None or row.temporary_bytes > 0
        assert row.violation == 0.0  # no joint
        assert row.iterations >= 1
    # of second order by the scheme, of order 8 by the stages
    assert coarse.energy_drift / fine.energy_drift == pytest.approx(4.0, rel=0.15)
    assert explicit.energy_drift < 1e-4 * fine.energy_drift
    assert "Newton" in impatient.failure and impatient.unfinished == 20
    assert forbidden.failure.startswith("ValueError: `sensitivity`")


def test_recommendations(table):
    explicit = table.rows[2]
    fastest = min((row for row in table if row.error <= 0.05), key=lambda row: row.seconds)
    assert recommend(table, 0.05).row is fastest
    vague = dataclasses.replace(table, reference=dataclasses.replace(table.reference, value_error=1e-3))
    assert "reference itself is known to 1e-03 only" in str(recommend(vague, 1e-4))
    best = recommend(table, 2 * explicit.error + table.reference.error)
    assert best.row is explicit and best.setting is SETTINGS[2] and best.margin > 1
    assert str(explicit.setting.num_steps) in str(best) and best
    none = recommend(table, 0.5 * explicit.error)
    assert not none and none.row is None and none.margin == 0.0 and "no setting meets it; the best" in str(none)
    with pytest.raises(ValueError, match="no setting meets it"):
        _ = none.setting
    assert recommend(table, 0.05, by="cpu_seconds")


def test_the_recommended_setting_is_used_as_it_is(table):
    value, _ = exact_with_gradient()
    setting = recommend(table, 1e-8).setting
    assert setting.evaluate(CRITERION, build, P, t1=T1) == pytest.approx(value, rel=1e-8)
    assert setting.trajectory(build, P, t1=T1).t.shape == (setting.num_steps + 1,)


EARLY = lg.Criterion(integrand=lambda s, p: jnp.exp(-((s.t / 0.15) ** 2)) * (s.body("mass").position[2] - 1.0) ** 2)
PLACED = Setting(40, pilot=40)


def early(p):
    """Its value, by a trapezoidal rule whose error is (h/0.15 s)² = 1e-8 of it at most."""
    t = jnp.linspace(0.0, T1, 70_001)
    w = jnp.sqrt(p["k"] / p["m"])
    return jnp.trapezoid(jnp.exp(-((t / 0.15) ** 2)) * (V / w * jnp.sin(w * t)) ** 2, t)


@pytest.mark.slow  # two programs; `test_steps_for` has what places them
def test_steps_placed_for_a_criterion():
    """Of one that looks at the begin only: as many steps leave less than half of the errors."""
    value, gradient = jax.value_and_grad(early)(jax.tree.map(jnp.asarray, P))
    exact = accuracy.Reference(float(value), np.array([gradient[name] * P[name] for name in sorted(P)]), 1e-8, 1e-8)
    equal, placed = work_precision(EARLY, build, P, (Setting(40), PLACED), t1=T1, reference=exact, progress=False)
    assert equal.error > 1e-3 and placed.value_error < 0.5 * equal.value_error
    assert placed.gradient_error < 0.5 * equal.gradient_error
    assert (placed.setting.label, placed.setting.curve) == ("placed GeneralizedAlpha()", "placed GeneralizedAlpha")
    with pytest.raises(ValueError, match="placed for a criterion"):
        PLACED.trajectory(build, P, t1=T1)


@pytest.mark.slow
def test_they_are_those_of_steps_for():
    steps = lg.steps_for(EARLY, build, P, t1=T1, pilot=40, num_steps=40)
    own = lg.differentiate(EARLY, build, P, t1=T1, num_steps=40, integrator=steps.integrator)
    used = jax.jit(lambda p: PLACED.evaluate(EARLY, build, p, t1=T1))(jax.tree.map(jnp.asarray, P))
    assert float(used) == pytest.approx(float(own.value), rel=1e-12)  # the same steps, round-off


def test_text_and_json(table, tmp_path):
    text = str(table)
    assert "impatient" in text and "failed: Newton" in text and "reference: Ψ" in text
    document = json.loads(json.dumps(table.document(), allow_nan=False))
    assert [row["num_steps"] for row in document["rows"]] == [setting.num_steps for setting in SETTINGS]
    assert document["rows"][3]["value"] is None and document["rows"][3]["failure"]
    assert document["rows"][0]["gradient_error"] == table.rows[0].gradient_error
    again = accuracy.Table.from_document(document)
    assert str(again) == str(table) and str(recommend(again, 0.05)) == str(recommend(table, 0.05))
    figure = accuracy.plot(table, (1e-2, 1e-30), title="oscillator")
    left, right = figure.axes
    assert left.get_ylabel() == "relative error of Ψ [–]" and right.get_ylabel() == "relative error of dΨ/dp [–]"
    names = {line.get_label() for line in left.lines if not line.get_label().startswith("_")}
    assert names == {row.setting.curve for row in table if not row.failure}
    assert [note.get_text() for note in left.texts] == ["target 0.01"]  # nothing meets the other target
    assert lg.plotting.save(figure, tmp_path / "a.png").stat().st_size > 10_000  # an empty canvas has some 3 kB


def test_an_unfinished_table_is_gone_on_with(table):
    """What it has is not measured again, also where it comes from a file and knows its settings by name."""
    read = accuracy.Table.from_document(table.document())
    known = accuracy.Table(read.rows[:4], read.reference, read.rounds)
    kept = []
    settings = {"t1": T1, "progress": False, "keep": kept.append}
    found = work_precision(CRITERION, build, P, SETTINGS, known=known, **settings)  # the last one cannot be compiled
    assert len(kept) == 1 and len(kept[0]) == len(SETTINGS) == len(found)
    assert [row.setting for row in found] == list(SETTINGS)
    assert [row.seconds for row in found.rows[:3]] == [row.seconds for row in table.rows[:3]]
    assert found.reference is known.reference and found.rows[-1].failure
    assert len(work_precision(CRITERION, build, P, SETTINGS[:2], known=known, **settings)) == 2 and len(kept) == 1


@pytest.mark.slow  # nine programs
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fn": lambda t: t.body("no_such_body").position[-1, 0]}, "no_such_body"),
        ({"fn": lambda t: t.body("mass").position[-1]}, "`fn` must return a number, got shape (3,)"),
        ({"fn": lambda t: (t.t[0], t.t[1])}, "`fn` must return a number, got (ShapeDtypeStruct"),
        ({"build": lambda p: 3.0}, "`model` must be a Model or an AbstractSystem, got float"),
        ({"t1": -1.0}, "`t1` must be later than `t0`, got t0 = 0.0 s and t1 = -1.0 s"),
    ],
)
def test_what_never_works_is_said_at_once(change, message):
    with pytest.raises((ValueError, TypeError), match=says(message)):
        work_precision(**{"fn": CRITERION, "build": build, "p": P, "t1": T1, "progress": False} | change)


def test_settings():
    setting = Setting(20, lg.GeneralizedAlpha(0.5, tolerance=1e-5), model={"links": "rods"})
    assert setting == Setting(20, lg.GeneralizedAlpha(0.5, tolerance=1e-5), model={"links": "rods"})
    assert hash(setting) != hash(Setting(21, setting.integrator, model=setting.model))
    assert setting.label == "GeneralizedAlpha(rho_inf=0.5, tolerance=1e-05), links='rods'"
    assert setting.curve == "GeneralizedAlpha, links='rods'"
    assert Setting(5, DOPRI8, extrapolate=True).label == "extrapolated IndexReducedODE(solver=Dopri8())"
    assert Setting(5, extrapolate=3).label == "extrapolated (3 runs) GeneralizedAlpha()"
    assert Setting(5, lg.Richardson()).label == "Richardson()"
    assert (Setting(5, DOPRI8, name="a").label, Setting(5, DOPRI8, family="b").curve) == ("a", "b")
    assert len(set(accuracy.ladder())) == len(accuracy.ladder()) == 17
    assert {setting.num_steps for setting in accuracy.ladder(10)} == {5, 10, 20, 40, 80, 160, 640}
    with pytest.raises(ValueError, match="`num_steps` must be at least 1"):
        Setting(0)
    with pytest.raises(ValueError, match="`extrapolate` must be True, False, or a number of runs of at least 2, got 1"):
        Setting(5, extrapolate=1)
    with pytest.raises(ValueError, match="give `extrapolate` or `pilot`"):
        Setting(5, extrapolate=True, pilot=20)
    with pytest.raises(ValueError, match="`pilot` must be at least 1"):
        Setting(5, pilot=0)
    with pytest.raises(ValueError, match="options must be a dict"):
        Setting(5, model=3)
