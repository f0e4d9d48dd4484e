"""The console script: what it prints, what it writes, and what it says about bad input."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import resources

import pytest

from lgsens.cli import _optimize
from lgsens.cli._main import main
from lgsens.cli._search import table_lines

PNG = b"\x89PNG\r\n\x1a\n"
SHIPPED = (resources.files("lgsens.examples") / "data" / "five_link_suspension.toml").read_text(encoding="utf-8")


def run(capsys, *arguments):
    """Exit status, stdout and stderr of the command line."""
    try:
        status = main([str(argument) for argument in arguments])
    except SystemExit as stop:  # argparse's way out
        status = stop.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.fixture(scope="module")
def optimized(tmp_path_factory):
    """The design of k and c as by default, but with longer steps: a minute in all, most of it compiling."""
    out = tmp_path_factory.mktemp("optimize") / "new" / "folder"
    status = main(["optimize", "quarter-car", "--out", str(out), "--dt", "5e-3", "--quiet"])
    return status, out, json.loads((out / "result.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "ended, advice",
    [("infeasible", "widen what is varied"), ("stalled", "begin elsewhere"), ("steps", "Try more --steps")],
)
def test_what_helps_where_no_design_satisfies_the_constraints(ended, advice):
    found = {"gradient_check": {}, "seconds": {}, "feasible": False, "history": {"ended": ended}}
    *_, last = table_lines(found, [("mass [kg]", 1.0, 2.0, "", 1)])
    assert last.startswith("No design satisfied the constraints") and advice in last
    assert ("--steps" in last) == (ended == "steps")


@pytest.mark.slow
def test_the_optimum_is_better_feasible_and_constrained(optimized):
    status, _, result = optimized
    assert status == 0
    objective = result["objective"]
    assert objective["reduction"] == pytest.approx(1 - objective["after"] / objective["before"], rel=1e-12)
    assert objective["reduction"] >= 0.20  # what is promised; 0.57 is what a grid search over (k, c) finds
    # The reference is 7.697902 for h → 0; the scheme's own error at h = 5e-3 is 25 times the 3e-5 at 1e-3.
    assert objective["before"] == pytest.approx(7.697902, rel=1e-3)
    assert result["feasible"]
    for row in result["constraints"]:
        assert row["before"]["violation_over_scale"] <= 0  # an honest start
        assert row["after"]["violation_over_scale"] <= 1e-3
    active = [row["name"] for row in result["constraints"] if row["active"]]
    assert active == ["minimum spring length"]
    for design in result["design"].values():
        assert design["lower"] < design["after"] < design["upper"]


@pytest.mark.slow
def test_steps_for_an_accuracy(tmp_path, capsys):
    arguments = ["--accuracy", "1e-2", "--steps", "2", "--out", tmp_path / "out"]
    _, _, err = run(capsys, "optimize", "quarter-car", *arguments)
    assert "Psi_0 and its gradient at the start: error" in err
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    found = result["settings"]
    assert found["error"] <= 1e-2
    assert f"in {round(2.0 / found['dt'])} steps" in err
    assert abs(result["objective"]["before"] / 7.697902 - 1.0) <= 1e-2  # what was asked for, of the value for h → 0


@pytest.mark.slow
def test_the_report_is_complete(optimized):
    _, out, result = optimized
    assert sorted(path.name for path in out.iterdir()) == [
        "convergence.png",
        "mechanism.png",
        "response.png",
        "result.json",
        "suspension.json",
    ]
    for path in out.glob("*.png"):
        assert path.read_bytes().startswith(PNG) and path.stat().st_size > 20_000  # an empty canvas has some 3 kB
    assert result["design"]["stiffness"]["before"] == 109000.0
    assert result["design"]["damping"]["before"] == 4900.0
    for where in ("start", "optimum"):
        check = result["gradient_check"][where]
        assert check["directions"] == ["damping", "stiffness"]
        # Truncation (3e-5)² and round-off, that of Ψ₀ (1e-13, positions over h²) over 3e-5: both near 1e-8.
        assert max(check["relative_error"]) < 1e-6
    assert len(result["history"]["objective"]) <= result["settings"]["steps"] == 300
    assert result["history"]["ended"] == "converged"
    assert result["history"]["objective"][result["history"]["kept_step"]] == result["objective"]["after"]
    assert result["settings"]["dt"] == 5e-3 and result["settings"]["wheel"] == "hinged"
    assert set(result["versions"]) >= {"python", "jax", "lgsens", "optax"}
    assert result["seconds"]["compilation"] > 0 and result["seconds"]["optimization"] > 0


@pytest.mark.slow
def test_an_existing_directory_is_left_alone(optimized, capsys):
    _, out, _ = optimized
    before = (out / "result.json").read_bytes()
    status, _, err = run(capsys, "optimize", "quarter-car", "--out", out)
    assert status == 2
    assert "exists already" in err and "--overwrite" in err and err.count("\n") == 1
    assert (out / "result.json").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("parameters", ["k,c", "hardpoints", "k,c,hardpoints"])
def test_every_choice_of_parameters_at_full_resolution(parameters, tmp_path, capsys):
    out = tmp_path / "out"
    status, text, err = run(capsys, "optimize", "quarter-car", "--out", out, "--parameters", parameters)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert status == 0 and "/300" in err and err.startswith("compiling the simulation … ")
    assert result["objective"]["reduction"] >= 0.20
    assert all(row["after"]["violation_over_scale"] <= 1e-3 for row in result["constraints"])
    # What holds the optimum back: the travel where only k and c are free, else the box.
    active = [row["name"] for row in result["constraints"] if row["active"]]
    if parameters == "k,c":
        assert active == ["minimum spring length"]
        assert "active" in text
    else:
        points = result["design"]["hardpoints"]
        moves = [b - a for link in points["after"] for a, b in zip(points["before"][link], points["after"][link])]
        assert len(moves) == 15
        assert max(map(abs, moves)) == pytest.approx(0.030, rel=1e-9)
    freed = parameters != "k,c"
    assert ("change of toe [deg]" in text) == (out / "curves.png").exists() == (result["curves"] is not None) == freed
    for check in result["gradient_check"].values():
        assert max(check["relative_error"]) < 1e-5  # round-off of Ψ₀ over the step, 1e-12/3e-5 at h = 2e-3, times 10


def edited(old, new):
    assert old in SHIPPED
    return SHIPPED.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (edited("[design]", "[designs]"), "key 'designs'"),
        (
            edited("minimum_tyre_force = 650.0", "minimum_tire_force = 650.0"),
            "key 'design.minimum_tire_force'",
        ),
        (edited("[50000.0, 200000.0]", "[200000.0, 50000.0]"), "'design.stiffness': must be two numbers"),
        (edited("[1500.0, 10000.0]", "1500.0"), "'design.damping': must be two numbers [lower, upper]"),
        (
            edited("maximum_spring_length = 0.300", "maximum_spring_length = 0.2"),
            "must exceed minimum_spring_length",
        ),
        (
            edited("stiffness = 109000.0", "stiffness = 309000.0"),
            "'design.stiffness': the start, 309000.0, lies outside [50000.0, 200000.0]",
        ),
        (edited("damping = 4900.0", ""), "key 'damper.damping'"),
        (edited("name = ", "name == "), "line 10"),
    ],
)
def test_a_bad_hardpoint_file_is_named_with_its_key_or_line(text, message, tmp_path, capsys):
    path, out = tmp_path / "mine.toml", tmp_path / "out"
    path.write_text(text, encoding="utf-8")
    status, _, err = run(capsys, "optimize", "quarter-car", "--hardpoints", path, "--out", out)
    assert status == 2
    assert message in err and "mine.toml" in err
    assert err.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--hardpoints", "absent.toml"], "'absent.toml' cannot be read"),
        (["--steps", "0"], "argument --steps: must be at least 1, got 0"),
        (["--steps", "many"], "argument --steps: must be a whole number"),
        (["--dt=-1e-3"], "argument --dt: must be positive"),
        (["--t1", "nan"], "argument --t1: must be positive"),
        (["--travel", "80"], "argument --travel: 80 m is more than wheels move; did you mean 0.08?"),
        (["--dt", "0.3"], "--t1 must be a whole number of steps --dt, got t1 = 2.0 s and dt = 0.3 s"),
        (["--dt", "5"], "--t1 must be a whole number of steps --dt"),
        (["--accuracy", "2"], "`accuracy` must be a number between 0 and 1, got 2.0"),
        (["--parameters", "mass"], "argument --parameters: invalid choice: 'mass'"),
        (["--wheel", "square"], "argument --wheel: invalid choice: 'square'"),
    ],
)
def test_bad_arguments_give_one_line(arguments, message, tmp_path, capsys):
    out = tmp_path / "out"
    status, text, err = run(capsys, "optimize", "quarter-car", "--out", out, *arguments)
    assert status == 2
    assert message in err and err.count("\n") == 1 and text == ""
    assert not out.exists()


@pytest.mark.slow
def test_travel_out_of_reach_names_its_option(tmp_path, capsys):
    status, _, err = run(capsys, "curves", "quarter-car", "--travel", "0.9", "--points", "3", "--out", tmp_path / "out")
    assert status == 2 and err.count("\n") == 1 + err.count("compiling")
    assert "error: argument --travel 0.9: too much for this suspension, give less. No position satisfies" in err


@pytest.mark.parametrize("arguments", [[], ["optimise"], ["optimize"], ["optimize", "half-car"], ["top", "--h", "0.5"]])
def test_bad_commands_give_one_line(arguments, capsys):
    status, _, err = run(capsys, *arguments)
    assert status == 2
    assert re.match(r"lgsens( \w+)?: error: .*\n$", err)


def test_a_missing_matplotlib_is_told_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    status, _, err = run(capsys, "optimize", "quarter-car", "--out", tmp_path / "out")
    assert status == 2
    assert 'pip install "lgsens[plot]"' in err


def sensitivities(text):
    """The derivatives that `lgsens top` prints, by method."""
    return {name.strip(): float(value) for name, value in re.findall(r"^(\S.*?)  +(-0\.\d{15,})", text, re.MULTILINE)}


@pytest.mark.slow  # three runs
def test_top_agrees_with_the_reference_as_its_order_says(capsys):
    reference = -0.0021318254254500
    status, text, _ = run(capsys, "top", "--h", 2e-3)
    values = sensitivities(text)
    assert status == 0 and len(values) == 6
    assert values.pop("reference, converged") == reference
    assert values.pop("paper, alpha_0 = 0.785398") == -0.002131825283595
    ddm = values.pop("DDM, jax.jacfwd")
    for name, value in values.items():
        # The methods are one operator and its transpose; differences of fourth order are good to 1e-9.
        tolerance = 1e-8 if name == "finite differences" else 1e-11
        assert value == pytest.approx(ddm, rel=tolerance), name
    # The scheme is of second order, its error 6.2e-6 at h = 5e-4: 16 times that, and higher terms.
    assert abs(ddm / reference - 1) == pytest.approx(16 * 6.2e-6, rel=0.03)
    # The table says so itself, in its column of relative errors.
    assert f"{abs(ddm / reference - 1):.2e}" in text


def test_the_module_is_the_script(capsys):
    assert re.fullmatch(r"lgsens \S+\n", run(capsys, "--version")[1])
    done = subprocess.run([sys.executable, "-m", "lgsens", "--help"], capture_output=True, text=True, check=True)
    assert re.search(r"optimize[\s\S]*top", done.stdout)


QUICK = ["--t1", "0.2", "--dt", "0.01", "--steps", "40", "--quiet"]


@pytest.mark.slow  # four processes that compile
def test_an_interrupted_command_writes_what_there_is_and_goes_on(tmp_path):
    """Ctrl-C during the search: the best so far, and with --resume the optimum of a run that nobody stopped."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "programs")}

    def command(out, *more):
        arguments = [sys.executable, "-m", "lgsens", "optimize", "quarter-car", "--out", str(tmp_path / out), *QUICK]
        return subprocess.Popen([*arguments, *more], stderr=subprocess.PIPE, text=True, env=environment)

    def ended(process):
        said = process.communicate()[1]  # which closes the pipe
        return process.returncode, said

    optimum = lambda out: json.loads((tmp_path / out / "result.json").read_text(encoding="utf-8"))
    assert ended(command("whole"))[0] in (0, 1)
    stopped = command("stopped")
    while not (tmp_path / "stopped" / "search.npz").exists():
        assert stopped.poll() is None
        time.sleep(0.01)
    stopped.send_signal(signal.SIGINT)
    status, said = ended(stopped)
    assert status == 130 and "--resume goes on" in said and "Traceback" not in said
    assert optimum("stopped")["history"]["ended"] == "interrupted"
    assert {"response.png", "search.npz"} <= {path.name for path in (tmp_path / "stopped").iterdir()}
    status, said = ended(command("stopped", "--resume", "--speed", "33"))  # at once
    assert status == 2 and "argument --speed: what --resume goes on with has its default, not 33.0" in said
    assert ended(command("stopped", "--resume"))[0] in (0, 1)
    assert not (tmp_path / "stopped" / "search.npz").exists()
    for name in ("design", "objective", "history"):
        assert optimum("stopped")[name] == optimum("whole")[name]


@pytest.mark.slow  # three processes that begin to compile
@pytest.mark.parametrize("seconds", [0.2, 3.0, 9.0])
def test_an_interrupt_while_a_program_is_compiled(tmp_path, seconds):
    """Ctrl-C in the middle of a compilation: the shell's status and a sentence, no traceback and no signal of the
    compiler's threads."""
    arguments = [sys.executable, "-m", "lgsens", "optimize", "quarter-car", "--out", str(tmp_path / "new")]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    begun = process.stderr.read(len("compiling"))
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert begun == "compiling" and process.returncode == 130
    assert "interrupted before anything was found" in said and "Traceback" not in said


def test_an_interrupt_before_there_is_anything(tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(_optimize, "search", stop)
    status, _, said = run(capsys, "optimize", "quarter-car", *QUICK, "--out", tmp_path / "new")
    assert status == 130 and "interrupted before anything was found" in said
    assert not (tmp_path / "new").exists()
    status, _, said = run(capsys, "optimize", "quarter-car", "--out", tmp_path / "new", "--resume")
    assert status == 2 and "search.npz', from which to go on, is not there" in said
