"""README.md: its examples run and give what they say; its two commands are there."""

import re
from pathlib import Path

import numpy as np

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_examples(tmp_path, monkeypatch):
    """One after the other, as a reader would."""
    monkeypatch.chdir(tmp_path)  # where a sweep keeps its results
    source = "\n".join(re.findall(r"```python\n(.*?)```", README, re.DOTALL))
    names: dict = {}
    exec(compile(source, "README.md", "exec"), names)
    jax, psi, top = names["jax"], names["psi"], names["top"]
    printed = float(re.search(r"adjoint variable method: (-\d\.\d+)\.\.\.", source)[1])
    gradient = float(jax.grad(lambda a: psi(top(a)))(np.pi / 4))
    assert abs(gradient - printed) < 1e-8  # printed with eight decimals, cut
    assert names["g"].joints["pivot"].at.shape == (3,)
    assert float(np.abs(names["g"].bodies["top"].inertia).min()) > 0
    by_jax = float(jax.grad(lambda length: psi(top(0.7, length=length)))(1.0))
    # the same scheme in two programs, 1000 steps
    np.testing.assert_allclose(names["found"].gradient["side"]["length"], by_jax, rtol=1e-9)
    assert np.isfinite(names["found"].value["force"])
    assert names["values"].shape == names["gradient"]["mass"].shape == (500,)


def test_commands():
    commands = dict(re.findall(r"<!-- (main job|tests) -->\n```sh\n(.*?)\n```", README, re.DOTALL))
    assert "lgsens optimize quarter-car" in commands["main job"]
    assert "pytest" in commands["tests"]
