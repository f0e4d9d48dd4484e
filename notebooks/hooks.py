"""What the site is made of: README, the pages and notebooks beside this file, pictures, a page for each public name.

Files keep their places in the repository, so that their links hold there and on the site. Pages of names are made of
docstrings: `api/lgsens.simulate.md` says `::: lgsens.simulate`. A name that several namespaces have, as one object, has
one page, and each namespace lists it. Names in code spans of all pages lead there.
"""

import ast
import enum
import functools
import html
import importlib
import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import latex2mathml.converter
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
SHOWN = (
    *("README.md", "notebooks/**/*.md", "notebooks/*.ipynb", "benchmarks/README.md", "benchmarks/results/*.png"),
    "tests/data/README.md",
)
NAMESPACES = (
    *("lgsens", "lgsens.model", "lgsens.integrate", "lgsens.liegroups", "lgsens.analysis", "lgsens.accuracy"),
    *("lgsens.optimize", "lgsens.sweeps", "lgsens.testing", "lgsens.plotting", "lgsens.examples", "lgsens.importers"),
    "lgsens.rigs",
)
FORMULA = r"\$\$(.+?)\$\$|\\\[(.+?)\\\]|\$(.+?)\$|\\\((.+?)\\\)"  # newer mkdocs-jupyter writes \[…\] and \(…\)


@functools.cache
def public() -> dict[str, dict[str, str]]:
    """By namespace, its names (what its `__init__` re-exports as `X as X`) and where each has its page."""
    home: dict[tuple[str, int], str] = {}
    found = {}
    for namespace in NAMESPACES:
        module = importlib.import_module(namespace)
        imports = [node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.ImportFrom)]
        names = {alias.name for node in imports for alias in node.names if alias.asname == alias.name}
        found[namespace] = {
            name: f"{home.setdefault((name, id(getattr(module, name))), namespace)}.{name}"
            for name in sorted(names, key=lambda name: (name.lower(), name))
        }
    return found


def pages() -> Iterator[tuple[str, str]]:
    """Path and text of the pages of all namespaces and their names."""
    for namespace, names in public().items():
        module = importlib.import_module(namespace)
        rows = [f"| [`{name}`]({page}.md) | {_sentence(getattr(module, name))} |" for name, page in names.items()]
        about = inspect.getdoc(module) or ""
        yield f"api/{namespace}.md", "\n".join([f"# {namespace}", "", about, "", "| | |", "|---|---|", *rows, ""])
        for name, page in names.items():
            if page.rpartition(".")[0] == namespace:
                yield f"api/{page}.md", f"::: {page}\n{_members(getattr(module, name))}"


def _members(found: Any) -> str:
    """Those of an enumeration, which have no docstrings."""
    if not isinstance(found, enum.EnumMeta):
        return ""
    rows = (f"| `{member.name}` | {getattr(member, 'message', member.value)} |" for member in found)
    return "\n".join(["", "| | |", "|---|---|", *rows, ""])


def _sentence(found: Any) -> str:
    """The first sentence of a docstring, in a cell of a table; of a value, what it is."""
    if not (inspect.isroutine(found) or inspect.isclass(found)):
        return f"a {type(found).__name__}"
    paragraph = (inspect.getdoc(found) or "").partition("\n\n")[0].replace("\n", " ").replace("|", "\\|")
    return re.split(r"(?<=[.:])\s+(?=[A-Z])|:$", paragraph)[0]


def on_config(config):
    """Pages of names in the navigation, behind those that the configuration lists."""
    listed = [
        {
            namespace: [
                f"api/{namespace}.md",
                *({name: f"api/{page}.md"} for name, page in names.items() if page == f"{namespace}.{name}"),
            ]
        }
        for namespace, names in public().items()
    ]
    config.nav.append({"Names": listed})
    return config


@event_priority(100)  # before the plugin that looks for notebooks
def on_files(files, config):
    """Files from where they lie, and the pages of names."""
    for path in (path for pattern in SHOWN for path in sorted(ROOT.glob(pattern))):
        where = path.relative_to(ROOT).as_posix()
        files.append(File(where, str(ROOT), config.site_dir, config.use_directory_urls))
    for where, text in pages():
        files.append(File.generated(config, where, content=text))
    return files


def on_page_content(content, page, **_):
    """Code spans that are public names lead to their pages: `lg.sweep`, `GeneralizedAlpha(0.9)`, `lg.model.Frame`.

    And formulas of notebooks are MathML, which browsers show by themselves; nbconvert would have them load MathJax.
    """
    own, up = page.file.src_uri, os.path.relpath("api", os.path.dirname(page.url) or ".")

    def linked(span: re.Match) -> str:
        path = re.sub(r"^lg\.", "lgsens.", span[1])
        namespace, _, name = path.rpartition(".")
        found = public().get(namespace or "lgsens", {}).get(name) or (path if path in public() else None)
        return f'<a href="{up}/{found}.html">{span[0]}</a>' if found and own != f"api/{found}.md" else span[0]

    content = re.sub(r"<!-- Load mathjax -->.*?<!-- End of mathjax configuration -->", "", content, flags=re.DOTALL)
    parts = re.split(r"(<(pre|style|script|a|h\d|b|strong)\b.*?</\2>)", content, flags=re.DOTALL)
    for i in range(0, len(parts), 3):  # between those tags
        parts[i] = re.sub(r"<code>([A-Za-z][\w.]*)(?:\([^<]*\))?</code>", linked, parts[i])
        if own.endswith(".ipynb"):
            parts[i] = re.sub(FORMULA, _mathml, parts[i], flags=re.DOTALL)
    return "".join(part for i, part in enumerate(parts) if i % 3 < 2)


@event_priority(-100)  # after the plugin of notebooks
def on_post_page(output, **_):
    """Newer mkdocs-jupyter has every page load MathJax itself."""
    return re.sub(r"<script data-mkdocs-jupyter-mathjax=.*?</script>\s*", "", output, flags=re.DOTALL)


def _mathml(found: re.Match) -> str:
    block, inline = found[1] or found[2], found[3] or found[4]
    return latex2mathml.converter.convert(html.unescape(block or inline), display="block" if block else "inline")


class Constructors(griffe.Extension):
    """Constructors of classes that have none of their own, from their fields: Equinox modules and named tuples."""

    def on_package(self, *, pkg: griffe.Module, **_) -> None:
        for module in _modules(pkg):
            for cls in module.classes.values():
                if not cls.is_alias and "__init__" not in cls.members and not cls.name.startswith(("_", "Abstract")):
                    _construct(cls, getattr(importlib.import_module(module.path), cls.name))


def _construct(cls: griffe.Class, found: Any) -> None:
    if issubclass(found, enum.Enum) or not (hasattr(found, "__dataclass_fields__") or hasattr(found, "_fields")):
        return
    parameters = griffe.Parameters()
    for name, parameter in inspect.signature(found).parameters.items():
        annotation = getattr(cls.all_members.get(name), "annotation", None)
        default = None if parameter.default is parameter.empty else repr(parameter.default)
        kind = griffe.ParameterKind[parameter.kind.name.lower()]
        parameters.add(griffe.Parameter(name, annotation=annotation, kind=kind, default=default))
    cls.set_member("__init__", griffe.Function("__init__", parameters=parameters, parent=cls))


def _modules(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for inner in module.modules.values():
        if not inner.is_alias:
            yield from _modules(inner)
