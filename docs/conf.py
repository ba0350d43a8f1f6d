"""Settings of the site, which `make docs` builds into docs/_site."""

import inspect
import re
from pathlib import Path

import dsrc
from sim.catalog.load import list_scenarios, load_scenario

DOCS = Path(__file__).parent
HEADLINE = re.compile(r"^    # (.+)$|^    \"(\w+)\",$", re.MULTILINE)
"""Groups and names of `dsrc.__all__`, in its own file."""

project, author, release = "dsrc-testbed", "The dsrc-testbed authors", dsrc.__version__
extensions = ["myst_parser", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
# What a command wrote beside a page is a download, not a page.
exclude_patterns = ["_site", "_pages", "zoo"]
html_theme, html_title = "furo", "dsrc-testbed"
html_extra_path = ["_pages"] if (DOCS / "_pages").is_dir() else []  # review pages that `make docs` writes
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
# Code outside of the site is a download, a page outside of it a link for readers of the repository alone.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "exclude-members": "__init__, __new__"}
napoleon_use_ivar = True
napoleon_numpy_docstring = False


def _api() -> str:
    """Return the page of the Python interface: every name of `dsrc.__all__`, in its groups."""
    listed = Path(inspect.getfile(dsrc)).read_text(encoding="utf-8").partition("__all__ = [")[2].partition("]")[0]
    lines = []
    for group, name in HEADLINE.findall(listed):
        if group:
            lines += [f"## {group.capitalize()}", ""]
            continue
        kind = "autofunction" if inspect.isroutine(getattr(dsrc, name)) else "autoclass"
        lines += ["```{eval-rst}", f".. {kind}:: dsrc.{name}", "```", ""]
    return "\n".join(lines)


def _gallery() -> str:
    """Return a card of every scenario that has a picture, with its review page where there is one."""
    cards = ["::::{grid} 1 2 3 3", ":gutter: 2", ""]
    for name in list_scenarios():
        picture = f"pictures/scenarios/{name}_above.png"
        if (DOCS / picture).is_file():
            cards += [f":::{{grid-item-card}} {name}", f":img-top: {picture}", f":img-alt: {name} from above", ""]
            cards += [load_scenario(name).description]
            if (DOCS / "_pages" / f"{name}.html").is_file():
                cards += ["", f'<a href="{name}.html">Look around in it</a>']
            cards += [":::", ""]
    return "\n".join([*cards, "::::", ""])


def _fill(app: object, page: str, source: list[str]) -> None:
    """Write what is made of the package into the pages that ask for it."""
    for mark, text in (("<!-- api -->", _api), ("<!-- gallery -->", _gallery)):
        if mark in source[0]:
            source[0] = source[0].replace(mark, text())


def setup(app: object) -> None:
    """Connect the pages that are made of the package."""
    app.connect("source-read", _fill)  # type: ignore[attr-defined]
