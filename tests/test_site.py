"""notebooks/mkdocs.yml: the site builds without a warning, every public name has a page, no link leads nowhere.

And what its pages are made of: the names that docstrings describe are those of the signatures, and tables are what
`benchmarks/pages.py` makes of benchmarks/results.
"""

import ast
import html
import importlib
import importlib.util
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import lgsens

ROOT = Path(__file__).parents[1]
NAMESPACES = (
    *("", ".model", ".integrate", ".liegroups", ".analysis", ".accuracy", ".optimize", ".sweeps", ".testing"),
    *(".plotting", ".examples", ".importers", ".rigs"),
)


def public(namespace):
    """What its `__init__` re-exports as `X as X`."""
    path = Path(lgsens.__file__).parent / namespace.removeprefix(".") / "__init__.py"
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    aliases = [alias for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names]
    return sorted(alias.name for alias in aliases if alias.name == alias.asname)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The text of each page by its path, and "": the folder."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "notebooks/mkdocs.yml", "-d", str(folder)]
    settings = {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-5000:]
    return {path: path.read_text(encoding="utf-8") for path in folder.rglob("*.html")} | {"": folder}


def pages(site):
    return {path: text for path, text in site.items() if path}


def leads_to(page, link):
    """The file and the fragment that a link of a page asks for."""
    parts = urlsplit(html.unescape(link))
    path = Path(os.path.normpath(page.parent / unquote(parts.path))) if parts.path else page
    return path, unquote(parts.fragment)


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_has_a_page(site, namespace):
    index = site[""] / "api" / f"lgsens{namespace}.html"
    links = dict(re.findall(r'<a href="([^"]+)"><code>(\w+)</code></a>', site[index]))
    where = {name: link for link, name in links.items()}
    names = public(namespace)
    assert len(names) > 2
    for name in names:
        page, _ = leads_to(index, where[name])
        assert re.search(rf'<h1 id="lgsens[\w.]*\.{name}" class="doc doc-heading">', site[page]), name


def test_no_link_leads_nowhere(site):
    ids = {page: set(map(html.unescape, re.findall(r'\bid="([^"]+)"', text))) for page, text in pages(site).items()}
    asked = 0
    for page, text in pages(site).items():
        if page.name == "404.html":  # its links are absolute
            continue
        for link in re.findall(r'<(?:a|img|script|link)\b[^>]*?\b(?:href|src)="([^"]*)"', text):
            if re.match(r"https?:|data:|mailto:|javascript:", link):
                continue
            path, fragment = leads_to(page, link)
            assert path.exists(), (page, link)
            assert not fragment or path not in ids or fragment in ids[path], (page, link)
            asked += 1
    assert asked > 5000


def test_nothing_is_loaded_from_elsewhere(site):
    """Nor is a formula left to a script."""
    for page, text in pages(site).items():
        assert not re.findall(r'<(?:img|script|link rel="stylesheet")[^>]*(?:src|href)="(?:https?:)?//[^"]*"', text), (
            page
        )
        assert "MathJax" not in text, page
    notebook = site[site[""] / "notebooks" / "01_first_gradient.html"]
    assert notebook.count("<math") > 10
    prose = re.sub(r"<(pre|style|script)\b.*?</\1>", "", notebook, flags=re.DOTALL)
    assert not re.search(r"\$|\\[(\[]", prose)


def test_docstrings_describe_arguments_that_are_there():
    """`Arguments:` of functions and of constructors; mkdocstrings does not look into "a, b: …"."""
    asked = 0
    for namespace in NAMESPACES:
        module = importlib.import_module(f"lgsens{namespace}")
        for name in public(namespace):
            found = getattr(module, name)
            section = re.search(r"^Arguments:\n((?: .*\n?|\n)+)", inspect.getdoc(found) or "", re.MULTILINE)
            if not section or not callable(found):
                continue
            described = re.findall(r"^    ([\w*]+(?:, [\w*]+)*): ", section[1], re.MULTILINE)
            there = inspect.signature(found).parameters
            for argument in (one.strip("*") for names in described for one in names.split(", ")):
                assert argument in there, (name, argument)
                asked += 1
    assert asked > 300


def test_tables_are_what_the_scripts_wrote(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    # by its path: `tests/plotting` has a module of that name, too
    spec = importlib.util.spec_from_file_location("pages_of_results", ROOT / "benchmarks" / "pages.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    where = {page for page, *_ in made.TABLES.values()}
    assert len(where) > 10
    for page in sorted(where):
        text = (made.GUIDE / f"{page}.md").read_text(encoding="utf-8")
        assert made.filled(page, text) == text, f"{page}: run `python benchmarks/pages.py`"
