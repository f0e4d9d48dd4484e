"""The problems of `lgsens.examples` are those of the reference files, no more and no less."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_runs import DATA, document

import lgsens as lg
from lgsens import examples
from lgsens.examples import PROBLEMS


def parameters_of_file(name):
    """The parameters of a problem as its file states them."""
    contents, case = document(PROBLEMS[name].file), name.partition(".")[2]
    if contents["name"] == "spinning_top_brulls":
        cases = {each["label"]: each["params"] for each in contents["details_full_digits"]["cases"]}
        return {key: float(value) for key, value in cases[case].items()}
    return contents["params"].get(case, contents["params"])


def test_every_file_has_its_problem():
    files = {path.name for path in DATA.glob("*.json")}
    # the scheme's own values of the spinning top, redundant constraints and a linkage of beams have tests of their own
    others = {"spinning_top_discrete_galpha.json", "bricard_A04.json", "misaligned_four_bar.json"}
    assert {problem.file for problem in PROBLEMS.values()} == files - others
    assert all(problem.name == name for name, problem in PROBLEMS.items())
    for problem in PROBLEMS.values():
        assert document(problem.file)["name"] == problem.file.removesuffix(".json")


@pytest.mark.parametrize("name", PROBLEMS)
def test_parameters_are_those_of_the_file(name):
    problem, stated = PROBLEMS[name], parameters_of_file(name)
    assert {key: stated[key] for key in problem.parameters} == problem.parameters
    assert all(type(value) is float for value in problem.parameters.values())
    # the five-link car has its other numbers from its hardpoint file; tests/sensitivity compares what follows from them
    if problem.file != "five_link_quarter_car.json":
        assert stated.keys() == problem.parameters.keys()


def test_criteria_are_those_of_the_files():
    """Every value with a gradient in the files is a criterion of some problem, and the other way round."""
    found = {file: set() for file in {problem.file for problem in PROBLEMS.values()}}
    for problem in PROBLEMS.values():
        references = problem.reference(document(problem.file))
        assert references.keys() == problem.criteria.keys()
        for reference in references.values():
            found[problem.file].add(reference.value)
            assert set(reference.gradient) <= set(problem.parameters)
    for file, values in found.items():
        contents = document(file)
        stated = contents["value"]
        terminal = contents.get("details_full_digits", {}).get("pointwise_constraints", {})
        expected = set(stated.values()) if isinstance(stated, dict) else {stated}
        assert values == expected | {float(each["value"]) for each in terminal.values()}


@pytest.mark.parametrize("name", PROBLEMS)
def test_durations_are_those_of_the_files(name):
    """The last output time of the file, or the time that the name of the criterion or of the case says."""
    problem, contents = PROBLEMS[name], document(PROBLEMS[name].file)
    case = name.partition(".")[2]
    times = contents["t"][case] if isinstance(contents["t"], dict) else contents["t"]
    said = {"to_1s": 1.0, "to_2s": 2.0, "at_0.1s": 0.1, "at_0.3s": 0.3}
    assert problem.t1 == said.get(case, times[-1])


@pytest.mark.parametrize("name", PROBLEMS)
def test_scenes_have_strong_float_leaves(name):
    """Also where every parameter is a Python float; a weakly typed leaf would compile anew after an update."""
    problem = PROBLEMS[name]
    leaves = jax.tree.leaves(problem.build(problem.parameters))
    assert leaves
    assert all(leaf.dtype == jnp.float64 and not leaf.weak_type for leaf in leaves)


def test_defaults_are_the_first_case():
    """A builder called without arguments is the problem of its file."""
    builders = {
        "heavy_top": "heavy_top_bruls2012.to_2s",
        "lagrange_top": "lagrange_top_analytic.nutating",
        "free_rigid_body": "free_rigid_body.asymmetric",
        "simple_pendulum": "simple_pendulum_A01",
        "slider_crank": "slider_crank_sundials",
        "four_bar": "four_bar_spring",
        "linear_quarter_car": "quarter_car_linear",
    }
    for builder, name in builders.items():
        function = getattr(examples, builder)
        assert list(inspect.signature(function).parameters) == list(PROBLEMS[name].parameters)
        scene, again = function(), PROBLEMS[name].build(PROBLEMS[name].parameters)
        for a, b in zip(jax.tree.leaves(scene), jax.tree.leaves(again), strict=True):
            np.testing.assert_array_equal(a, b)


def test_data_of_simo_and_wong():
    """m g l = 20 N m and moments (5, 5, 1) kg m² about the fixed point, by a body that can exist."""
    problem = PROBLEMS["lagrange_top_analytic.simo_wong"]
    body = problem.build(problem.parameters).bodies["top"]
    lever = float(jnp.linalg.norm(body.position))
    about_pivot = np.asarray(body.inertia) + float(body.mass) * lever**2 * np.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(about_pivot, [5.0, 5.0, 1.0], rtol=1e-14)
    np.testing.assert_allclose(float(body.mass) * lever * problem.parameters["g"], 20.0, rtol=1e-14)


def test_free_lengths_of_the_five_link_car():
    stated = document("five_link_quarter_car.json")["params"]
    problem = PROBLEMS["five_link_quarter_car"]
    forces = problem.build(problem.parameters).forces
    spring, tyre = forces["spring"], forces["tyre"]
    assert isinstance(spring, lg.SpringDamper) and isinstance(tyre, lg.TyreSpring)
    assert isinstance(tyre.road, lg.BumpRoad)
    found = (spring.free_length, tyre.free_radius, tyre.stiffness, tyre.road.duration)
    assert found == tuple(stated[key] for key in ("l0", "Rf", "kt", "Tb"))
