"""The layers of the library, from its import statements; and what it must not do when it is imported."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import lgsens
from lgsens.model import AbstractElement, AbstractForce, AbstractJoint

ROOT = Path(lgsens.__file__).parent
# The packages from the ground up: each may import those of earlier ranks. `_validate` is below all of them.
RANKS = (
    ("liegroups", "linear"),
    ("dynamics",),
    ("model", "integrate"),
    ("sensitivity",),
    ("simulation",),
    ("criteria",),
    ("analysis",),
    ("sweeps", "examples", "importers"),
    ("rigs",),
    ("plotting",),
    ("accuracy", "optimize", "testing"),
    ("cli",),
)
BELOW = {name: {below for rank in RANKS[:i] for below in rank} for i, rank in enumerate(RANKS) for name in rank}
AT_ROOT = {"__init__", "__main__", "_brief", "_progress", "_validate", "_xla"}
FOUNDATION = "lgsens._validate"
FOUNDATIONS = {FOUNDATION, "lgsens._brief", "lgsens._progress", "lgsens._xla"}
MAX_LINES = 350


def module_name(path: Path) -> str:
    parts = ("lgsens", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}


def imports(name: str) -> set[str]:
    """The modules of lgsens that a module imports anywhere in it, also inside functions and relative ones."""
    package = name if FILES[name].name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*base, *(node.module or "").split(".")]).rstrip(".")
            # `from lgsens import x`: x may be a module or a name of the package
            found |= {full if (full := f"{module}.{alias.name}") in FILES else module for alias in node.names}
    return {module for module in found if module == "lgsens" or module.startswith("lgsens.")}


def layer(name: str) -> str:
    """The package of a module, or "" for the modules above the packages."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in BELOW else ""


def test_every_package_has_a_rank():
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} == set(BELOW)
    assert {path.stem for path in ROOT.glob("*.py")} == AT_ROOT


def test_the_parser_sees_what_there_is():
    assert imports("lgsens.liegroups._products") == {"lgsens.liegroups._base"}  # a relative import
    assert {"lgsens.dynamics", "lgsens.model", "lgsens.simulation._errors"} <= imports("lgsens.simulation._simulate")
    assert "lgsens.simulation" in imports("lgsens")


def test_imports_go_downwards():
    wrong = []
    for name in filter(layer, FILES):
        own, imported = layer(name), imports(name)
        wrong += [(name, other) for other in imported - FOUNDATIONS if layer(other) not in BELOW[own] | {own}]
        if own == "liegroups" and FOUNDATION in imported:
            wrong.append((name, FOUNDATION))
    assert not wrong


def test_foundation_imports_nothing_of_the_library():
    assert imports(FOUNDATION) == set()


def test_packages_import_only_public_names_of_each_other():
    """A private module belongs to its package."""
    for name in FILES:
        for imported in imports(name) - {FOUNDATION}:
            private = imported.rpartition(".")[2].startswith("_")
            if private and layer(imported):
                assert layer(name) == layer(imported), f"{name} imports {imported}"


def test_no_import_cycles():
    done, path = set(), []

    def visit(name):
        assert name not in path, f"cycle: {' → '.join([*path[path.index(name) :], name])}"
        if name in done:
            return
        path.append(name)
        for imported in sorted(imports(name) & set(FILES)):
            visit(imported)
        path.pop()
        done.add(name)

    for name in FILES:
        visit(name)


def test_modules_are_small():
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in FILES.items()}
    assert not {name: count for name, count in lines.items() if count > MAX_LINES}


def touches_config(tree) -> bool:
    """`jax.config…`, `from jax import config`, `from jax.config import …`, `jax.enable_x64…`."""
    switches = {"config", "enable_x64"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == "jax" and node.attr in switches:
                return True
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")
            if module[0] == "jax" and {*module, *(alias.name for alias in node.names)} & switches:
                return True
    return False


def test_config_is_recognized():
    for source in (
        "jax.config.update('x', 1)",
        "from jax import config",
        "def f():\n  with jax.enable_x64(True): pass",
    ):
        assert touches_config(ast.parse(source))
    assert not touches_config(ast.parse("import jax\njax.jit(config.update)"))


def test_the_library_never_touches_jaxs_config():
    """But for `compilation_cache`, which does nothing else, and the command line."""
    touching = {name for name in FILES if layer(name) != "cli" and touches_config(TREES[name])}
    assert touching == {"lgsens._xla"}


def element_types(base: type) -> dict[str, str]:
    """The library's final types under an abstract one by name, and the modules that define them."""
    own = {base.__name__: base.__module__} if not base.__name__.startswith("Abstract") else {}
    found = [own, *map(element_types, base.__subclasses__())]
    return {name: module for types in found for name, module in types.items() if module in FILES}


def asks_for(tree, types: set[str]) -> set[str]:
    """Those of the types for which `isinstance` or `issubclass` asks, or which are compared, also by another name."""
    names = lambda node: {getattr(part, "id", getattr(part, "attr", None)) for part in ast.walk(node)}
    known = {name: {name} for name in types}
    for node in tree.body:
        if isinstance(node, ast.Assign):
            mentioned = set().union(*(known.get(name, set()) for name in names(node.value)))
            known |= {name: mentioned for target in node.targets for name in names(target)}
    found = set()
    for node in ast.walk(tree):
        called = names(node.func) if isinstance(node, ast.Call) else set()
        compared = names(node) if isinstance(node, ast.Compare) else set()
        if called & {"isinstance", "issubclass"} or "type" in compared:
            found |= names(node)
    return set().union(*(known.get(name, set()) for name in found))


def test_types_of_elements_are_asked_for_in_their_own_file_only():
    """What others want to know of a joint, a force, a constraint or a load, it says itself."""
    types = {}
    for base in (AbstractJoint, AbstractForce, AbstractElement):
        types |= element_types(base)
    assert {"RevoluteJoint", "Coincidence", "SpringDamperLoad", "Gravity", "Angle"} <= set(types)
    for source in (
        "SPRINGS = (Coil, lg.Bushing)\nisinstance(force, SPRINGS)",
        "if isinstance(a, lg.Bushing | Other): pass",
        "x = type(force) is Bushing",
    ):
        assert asks_for(ast.parse(source), set(types)) == {"Bushing"}
    for name, tree in TREES.items():
        foreign = {kind for kind in asks_for(tree, set(types)) if types[kind] != name}
        assert not foreign, f"{name} asks whether an element is a {sorted(foreign)}; let the element declare it"


def test_import_creates_no_arrays():
    """An array made at import is float32 where x64 is switched on later."""
    code = """
import jax
import lgsens, lgsens.examples
assert not jax.config.jax_enable_x64
assert jax.live_arrays() == [], jax.live_arrays()
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
leaves = jax.tree.leaves(lgsens.examples.spinning_top(jnp.asarray(0.7)))
assert all(leaf.dtype == jnp.float64 for leaf in leaves)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr


def test_namespaces_are_attributes():
    """`lgsens.accuracy`, `.examples` and the others need no import of their own; other names raise."""
    assert callable(lgsens.accuracy.work_precision)
    assert callable(lgsens.examples.spinning_top)
    assert callable(lgsens.optimize.minimize)
    assert lgsens.plotting.__name__ == "lgsens.plotting"
    assert callable(lgsens.testing.check_sensitivities)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = lgsens.nothing
