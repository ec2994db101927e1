"""Sphinx's settings for the guide: ``sphinx-build -W -c docs/guide docs target/guide``.

The source folder is ``docs/``, so that the pages and the documents that they refer to make one site.
"""

import re
from dataclasses import is_dataclass
from importlib.metadata import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.ext.napoleon import GoogleDocstring

ROOT = Path(__file__).parents[2]
PACKAGE = metadata("upcr")

project = "UPCR"
release = PACKAGE["Version"]
root_doc = "guide/index"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
nitpicky = True
# Types of other packages, whose references are not at hand without a network, and names that speak for themselves.
nitpick_ignore_regex = [
    ("py:class", r"(numpy|npt|os|collections|typing|pyarrow|pa|ray)\..*|NDArray|Unpack"),
    ("py:class", "CloudLike|FloatArray|Pairs?|Method|Feature|Refinement|Kernel|Reason|Dataset|Table"),
    ("py:exc", r"ray\..*"),
]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

# `upcr.ray` can be described without Ray.
autodoc_mock_imports = [name for name in ("pyarrow", "ray") if find_spec(name) is None]
autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("CloudLike", "FloatArray", "npt.ArrayLike")}

html_theme = "furo"
html_title = f"UPCR {release}"
html_static_path = ["guide.css"]
html_css_files = ["guide.css"]
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False


def link_to_the_repository(app: Sphinx, docname: str, source: list[str]) -> None:
    """Links that leave ``docs/`` lead to the repository."""
    folder = Path(app.srcdir, docname).parent
    repository = PACKAGE["Project-URL"].removeprefix("Source, ")

    def led(link: re.Match[str]) -> str:
        path = (folder / link[1]).resolve()
        if path.is_relative_to(app.srcdir):
            return link[0]
        if not path.exists():
            raise ExtensionError(f"{docname}: there is no {link[1]}")
        return f"]({repository}/blob/main/{path.relative_to(ROOT)}{link[2] or ''})"

    source[0] = re.sub(r"\]\((\.\./[^)#\s]+)(#[^)\s]+)?\)", led, source[0])


def open_at_the_guide(app: Sphinx, exception: Exception | None) -> None:
    """The folder itself opens the first page."""
    page = f'<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={root_doc}.html">'
    (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def read_google_style(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Sections of functions and classes; what is said of an attribute is a sentence, in which a colon is a colon."""
    if what not in ("attribute", "data", "property"):
        lines[:] = GoogleDocstring(lines, what=what, name=name, obj=obj, options=options).lines()


def hide_constructor(app: Sphinx, what: str, name: str, obj: Any, *rest: Any) -> tuple[str, None] | None:
    """Of what is returned, never made."""
    return ("", None) if what == "class" and is_dataclass(obj) else None


def setup(app: Sphinx) -> None:
    app.connect("autodoc-process-signature", hide_constructor)
    app.connect("autodoc-process-docstring", read_google_style)
    app.connect("source-read", link_to_the_repository)
    app.connect("build-finished", open_at_the_guide)
