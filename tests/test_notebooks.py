"""notebooks/*.ipynb: every cell runs, nothing is shown that did not come out of it, figures are committed and small.

The code cells of a notebook run one after the other in one namespace, as a kernel would run them, but in this process,
which has imported everything. What a notebook claims is asserted in its cells. The outputs that are committed come from
a kernel: `jupyter execute --inplace notebooks/*.ipynb`, with the extra `notebooks`.
"""

import ast
import functools
import importlib
import inspect
import json
import re
from pathlib import Path

import jax
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
NAMES = sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))


def read(name):
    return json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))


def cells(name, kind):
    return [cell for cell in read(name)["cells"] if cell["cell_type"] == kind]


def run(source, filename, names):
    """Run a cell; returns the value of its last expression, which a notebook shows."""
    *body, last = ast.parse(source).body
    if not isinstance(last, ast.Expr):
        body, last = [*body, last], None
    exec(compile(ast.Module(body, []), filename, "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), filename, "eval"), names)


@pytest.mark.slow  # half a minute or more each
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs(name, tmp_path, monkeypatch):
    """And shows figures where they are committed."""
    monkeypatch.chdir(tmp_path)  # where a notebook writes
    names: dict = {"__name__": "__main__"}
    for i, cell in enumerate(cells(name, "code")):
        shown = run("".join(cell["source"]), f"{name}, code cell {i + 1}", names)
        is_figure = hasattr(shown, "_repr_png_")
        committed = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
        assert len(committed) == is_figure
        if is_figure:
            assert shown._repr_png_().startswith(b"\x89PNG")
    jax.clear_caches()


def imported(tree):
    """What the modules are called that a cell imports as `import a.b as c` or `from a import b`."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {of.asname: importlib.import_module(of.name) for of in node.names if of.asname}
        if isinstance(node, ast.ImportFrom):
            names |= {of.asname or of.name: getattr(importlib.import_module(node.module), of.name) for of in node.names}
    return names


@pytest.mark.parametrize("name", NAMES)
def test_what_a_notebook_asks_for_is_there(name):
    """Every name of a module that its cells use, and every keyword that they give to a function of lgsens."""
    tree = ast.parse("\n".join("".join(cell["source"]) for cell in cells(name, "code")))
    names, asked = imported(tree), 0
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute | ast.Call):
            of = node.func if isinstance(node, ast.Call) else node
            parts = ast.unparse(of).split(".")
            if parts[0] not in names or not all(map(str.isidentifier, parts)):
                continue
            found = functools.reduce(getattr, parts[1:], names[parts[0]])
            if isinstance(node, ast.Call) and str(getattr(found, "__module__", "")).startswith("lgsens"):
                inspect.signature(found).bind_partial(**{word.arg: None for word in node.keywords if word.arg})
                asked += 1
    assert asked > 3


@pytest.mark.parametrize("name", NAMES)
def test_what_is_committed(name):
    code = cells(name, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))  # run once, in order
    outputs = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"stream", "execute_result"}  # no error among them
    assert not [output for output in outputs if output.get("name") == "stderr"]  # nor a warning
    figures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(figures) >= 1
    assert sum("assert " in "".join(cell["source"]) for cell in code) >= 2
    path = NOTEBOOKS / f"{name}.ipynb"
    assert path.stat().st_size < 400e3
    assert not re.search(r"/(home|root|tmp|Users)/|0x[0-9a-f]{8}", path.read_text(encoding="utf-8"))
    for cell in cells(name, "markdown"):
        for link in re.findall(r"\]\(([^)#]+)\)", "".join(cell["source"])):
            assert link.startswith("https://") or (NOTEBOOKS / link).exists(), link
