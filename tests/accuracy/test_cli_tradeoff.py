"""`lgsens tradeoff`: a file of one's own, what is written and printed, bad input, and the results in the repository."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from lgsens.accuracy import Setting
from lgsens.cli._main import main
from lgsens.cli._tradeoff import SCENES
from lgsens.examples import PROBLEMS
from lgsens.integrate import Steps

PNG = b"\x89PNG\r\n\x1a\n"
ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
FILE = """
import lgsens as lg
from lgsens.accuracy import grid

V = 0.3


def build(p):
    spring = lg.SpringDamper(None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1), stiffness=p, free_length=1.0)
    body = lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0, 0, 1), velocity=(0, 0, V), free="z")
    return lg.Model({"mass": body}, {}, {"spring": spring})


def criterion(trajectory):
    return trajectory.body("mass").position[-1, 2]


parameters = 40.0
t1 = 1.0
"""
# dΨ/dp is 0.003 of Ψ, relative to p: with 10 steps the order-5 route leaves 2e-4 of it, more than the target.
SETTINGS = "settings = grid((20, 200), lg.GeneralizedAlpha()) + grid((20,), lg.IndexReducedODE())\n"


def run(capsys, *arguments):
    try:
        status = main(["tradeoff", *map(str, arguments)])
    except SystemExit as stop:  # argparse's way out
        status = stop.code
    return status, *capsys.readouterr()


@pytest.mark.slow  # nine programs
def test_a_file_of_ones_own(tmp_path, capsys):
    """z = 1 + V/ω sin ω, ω² = 20, at t = 1 s."""
    (tmp_path / "mine.py").write_text(FILE + SETTINGS, encoding="utf-8")
    out = tmp_path / "new" / "folder"
    status, text, _ = run(capsys, tmp_path / "mine.py", "--out", out, "--targets", "0.1", "1e-4")
    assert status == 0
    assert sorted(path.name for path in out.iterdir()) == ["tradeoff.json", "tradeoff.png"]
    assert (out / "tradeoff.png").read_bytes().startswith(PNG)
    document = json.loads((out / "tradeoff.json").read_text(encoding="utf-8"))
    w = np.sqrt(20.0)
    assert abs(document["reference"]["value"] / (1 + 0.3 / w * np.sin(w)) - 1) <= document["reference"]["value_error"]
    for recommendation in document["recommendations"]:
        row = document["rows"][recommendation["row"]]
        assert max(row["value_error"], row["gradient_error"]) <= recommendation["rtol"]
        assert recommendation["reason"] in text
    assert document["scene"] == "mine" and str(tmp_path) not in json.dumps(document)
    assert run(capsys, tmp_path / "mine.py", "--out", out)[0] == 2  # the folder exists


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t1 = 1.0", ("must define `build`, a function p ↦ Model", "`criterion`", "`parameters`")),
        ("t1 = one", ("cannot be run: NameError", "one")),
        ("def", ("cannot be run: SyntaxError",)),
        (FILE.replace("build(p)", "build(p, q)"), ("`build(parameters)` fails: TypeError", "'q'")),
        (FILE + "settings = [20]\n", ("`settings` must be values of Setting",)),
        (None, ("is neither a file nor one of", "quarter-car", "top")),
    ],
)
def test_bad_files(text, words, tmp_path, capsys):
    path = tmp_path / "mine.py"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    status, _, error = run(capsys, path, "--out", tmp_path / "out")
    assert status == 2 and error.startswith("lgsens tradeoff: error: ") and error.count("\n") == 1
    assert all(word in error for word in words)
    assert not (tmp_path / "out").exists()


def test_errors_are_relative(tmp_path, capsys):
    status, _, error = run(capsys, "top", "--targets", "2", "--out", tmp_path / "out")
    assert status == 2 and "argument --targets: must be less than 1, got 2; it is relative" in error


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    scene = SCENES[name]()
    assert len(scene.settings) >= 12 and len(set(scene.settings)) == len(scene.settings)
    assert all(isinstance(setting, Setting) for setting in scene.settings)


def test_a_ladder_of_three_programs():
    """Scene and kind of scheme, with room for 256 steps of every run, the reference's three runs too, are a program."""
    settings = SCENES["quarter-car"]().settings
    kinds = {(one.model, type(one.integrator), getattr(one.integrator, "solver", None)) for one in settings}
    assert len(kinds) == 3
    most = max(one.num_steps * 2 ** (one.runs - 1) for one in settings)
    reference = 4 * 4 * min(one.num_steps for one in settings)  # generalized-α, the finest of three (`converge`)
    assert Steps.of(max(most, reference), float).room == Steps.of(1, float).room


@pytest.mark.slow  # two minutes
def test_compilations_of_the_command(tmp_path, compiled):
    """Of fourteen settings and of the reference: three programs forward, three backward; and one for each number of
    steps that are placed."""
    jax.clear_caches()
    names, status = compiled(main, ["tradeoff", "quarter-car", "--quiet", "--out", str(tmp_path / "found")])
    assert status == 0
    placed = sum(setting.pilot is not None for setting in SCENES["quarter-car"]().settings)
    assert names.count("_motion") == names.count("_pulled_to_scene") == 3 + placed


def committed(name: str):
    document = json.loads((RESULTS / f"tradeoff_{name}.json").read_text(encoding="utf-8"))
    return document, [document["rows"][recommendation["row"]] for recommendation in document["recommendations"]]


def check_against(name: str, value: float, gradient: np.ndarray):
    """The recommended settings meet their targets by a reference that the run knew nothing of."""
    document, rows = committed(name)
    assert [recommendation["rtol"] for recommendation in document["recommendations"]] == [1e-2, 1e-4, 1e-6, 1e-8]
    for recommendation, row in zip(document["recommendations"], rows):
        error = np.abs(np.array(row["gradient"]) - gradient).max() / np.abs(gradient).max()
        assert max(abs(row["value"] / value - 1), error) <= recommendation["rtol"], row["setting"]


def test_the_top_as_committed():
    """Against numbers of order 18 in 80 bits, from another formulation."""
    problem = PROBLEMS["spinning_top_brulls.l_1.0_alpha0_0.785398"]
    text = (ROOT / "tests" / "data" / problem.file).read_text(encoding="utf-8")
    (reference,) = problem.reference(json.loads(text)).values()
    names = sorted(problem.parameters)  # as JAX flattens a dict
    check_against("top", reference.value, np.array([reference.gradient[n] * problem.parameters[n] for n in names]))
    document, _ = committed("top")
    cheapest = {}
    for row in document["rows"]:
        if not row["failure"] and max(row["value_error"], row["gradient_error"]) <= 1e-8:
            cheapest[row["family"]] = min(cheapest.get(row["family"], np.inf), row["seconds"])
    plain = cheapest.pop("GeneralizedAlpha")
    assert plain > 5 * min(cheapest.values())


def test_the_quarter_car_as_committed():
    """Against index-reduced equations under error control to 1e-12, with respect to 2 + 15 numbers."""
    found = json.loads((RESULTS / "rivals.json").read_text(encoding="utf-8"))["references"]["quarter_car"]
    stiffness, damping, *hardpoints = found["gradient"][:17]
    p = found["p"]
    size = max(map(abs, p[2:17]))
    gradient = [damping * p[1], *(slope * size for slope in hardpoints), stiffness * p[0]]  # by name
    check_against("quarter_car", found["value"], np.array(gradient))


def test_the_file_of_a_suspension_is_no_scene(tmp_path, capsys):
    (tmp_path / "car.toml").write_text("name = 1", encoding="utf-8")
    status, _, error = run(capsys, tmp_path / "car.toml", "--out", tmp_path / "out")
    assert status == 2 and "must be a Python file" in error and "lgsens optimize" in error
