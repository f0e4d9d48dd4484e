"""README.md and the pages of the guide: their examples run and give what they say; README's two commands are there.

The blocks marked `python` run, those of a page after those of README, as a reader would; `py` marks fragments.
"""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


PAGES = [path for path in sorted((ROOT / "notebooks").rglob("*.md")) if blocks(path.read_text(encoding="utf-8"))]
# Not in the quick run, whose small versions are `test_fidelity.py`, `test_step_jacobians.py`, `test_linearize.py`,
# `test_certify.py`, `test_flexible.py`, `test_suspension_files.py`, `test_own_elements.py`, `test_sweep.py`,
# `test_joint_motion.py` and, of choosing, `test_differentiate.py`.
LONG = {
    "choosing",
    "control",
    "design",
    "flexible",
    "fidelity",
    "own_elements",
    "small_motions",
    "suspension",
    "sweeps",
    "trust",
}
WHOLE = [pytest.param(path, marks=[pytest.mark.slow] * (path.stem in LONG), id=path.stem) for path in PAGES]


def run(text, filename, names):
    """The blocks of a page, one after the other; returns `names` with theirs."""
    exec(compile("\n".join(blocks(text)), filename, "exec"), names)
    return names


@pytest.fixture(scope="module")
def readme():
    """What the examples of README define."""
    return run(README, "README.md", {})


def test_readme(readme):
    jax, psi, top = readme["jax"], readme["psi"], readme["top"]
    printed = float(re.search(r"adjoint variable method: (-\d\.\d+)\.\.\.", README)[1])
    gradient = float(jax.grad(lambda a: psi(top(a)))(np.pi / 4))
    assert abs(gradient - printed) < 1e-8  # printed with eight decimals, cut
    assert readme["g"].joints["pivot"].at.shape == (3,)
    assert float(np.abs(readme["g"].bodies["top"].inertia).min()) > 0


def test_length_and_citation():
    assert len(README.splitlines()) <= 150
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in README


@pytest.mark.parametrize("path", WHOLE)
def test_page(path, readme, tmp_path, monkeypatch, capsys):
    """And prints what stands below its blocks, in a row, numbers of one or two digits aside: those are round-off."""
    monkeypatch.chdir(tmp_path)  # where a sweep keeps its results
    text = path.read_text(encoding="utf-8")
    names = run(text, path.name, dict(readme))
    words = lambda said: [line.split() for line in re.sub(r"\S*\de[+-]\d\d", "…", said).splitlines()]
    out, shown = (
        words(capsys.readouterr().out),
        words("".join(re.findall(r"\nprints\n\n```\n(.*?)```", text, re.DOTALL))),
    )
    assert bool(out) >= bool(shown) and out[: len(shown)] == shown
    CHECKS.get(path.stem, lambda names: None)(names)


def _choosing(names):
    jax, psi, top = names["jax"], names["psi"], names["top"]
    by_jax = float(jax.grad(lambda length: psi(top(0.7, length=length)))(1.0))
    # the same scheme in two programs, 1000 steps
    np.testing.assert_allclose(names["found"].gradient["side"]["length"], by_jax, rtol=1e-9)
    assert np.isfinite(names["found"].value["force"])


def _sweeps(names):
    assert names["values"].shape == names["gradient"]["mass"].shape == (500,)


def _control(names):
    """Misses are squares: their exponents double, to round-off; those of differences gain nine digits each at most."""
    exact, rough = (np.log10(names[of]) for of in ("misses", "by_differences"))
    assert exact[-1] < -20 and exact[-1] < 1.8 * exact[-2] < 1.8**2 * exact[-3]
    assert np.all(np.diff(rough)[-3:] > -9.0)


def _flexible(names):
    """The digits that it shows; the quick run ends before."""
    if "dimensions" in names:
        by_wall, by_end = 1e-3 * names["dimensions"]["thickness"], 1e-3 * names["strut"].knuckle
        np.testing.assert_allclose([names["value"], by_wall], [235.0, -55.2], rtol=0, atol=0.051)
        np.testing.assert_allclose(by_end, [0.46, -0.48, -0.52], rtol=0, atol=0.0051)


def _design(names):
    """The torque by positions alone, and by a simulation of second order in 120 steps of a turn."""
    of_positions = names["jax"].grad(lambda p: names["torque_and_swing"](p)[0])(names["best"].x)
    for name, slope in names["gradient"].items():
        np.testing.assert_allclose(slope, of_positions[name], rtol=0, atol=0.03)  # of 1.5


CHECKS = {"choosing": _choosing, "control": _control, "design": _design, "flexible": _flexible, "sweeps": _sweeps}


def test_commands():
    commands = dict(re.findall(r"<!-- (main job|tests) -->\n```sh\n(.*?)\n```", README, re.DOTALL))
    assert "lgsens optimize quarter-car" in commands["main job"]
    assert "pytest" in commands["tests"]
