"""Sphinx: the pages of this folder, and the API reference from the docstrings.

pip install '.[docs]' && sphinx-build -W -b html docs build/docs
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "drivers")]

from uwbslam_jax import __version__

project, release = "uwbslam_jax", __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
source_suffix = {".md": "markdown"}

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
# one line of a docstring may describe several arguments or fields: they are listed as they stand
napoleon_use_param = False
napoleon_custom_sections = [("Attributes", "params_style")]

html_theme = "furo"
html_title = "uwbslam_jax"
html_show_copyright = False

# Docstrings are plain text: what stands between backticks is code, and a bar or a star is itself
default_role = "code"
_MARKUP = re.compile(r"(`[^`]*`)|([|*])")
# what pages link to beside this folder, for those who read them in the repository, has a page of its own here
_BESIDE = {
    r"\.\./drivers/README\.md": "drivers.md",
    r"\.\./CONTRIBUTING\.md": "contributing.md",
    r"\.\./benchmarks/results/\w+\.md": "results.md",
}


def _as_plain_text(app, what, name, obj, options, lines: list[str]) -> None:
    lines[:] = [_MARKUP.sub(lambda m: m[1] or "\\" + m[2], line) for line in lines]
    if what in ("attribute", "data"):
        lines.insert(0, "\\")  # an empty first line: of a first line napoleon takes what precedes a colon for the type


def _without_fields(app, what, name, obj, skip, options) -> bool | None:
    """Fields of a NamedTuple have a docstring of their own, which only counts them."""
    return True if (getattr(obj, "__doc__", None) or "").startswith("Alias for field number") else None


def _linked_here(app, docname: str, source: list[str]) -> None:
    for link, page in _BESIDE.items():
        source[0] = re.sub(rf"\]\({link}(#[^)]*)?\)", rf"]({page}\1)", source[0])


def setup(app) -> None:
    app.connect("autodoc-process-docstring", _as_plain_text, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _without_fields)
    app.connect("source-read", _linked_here)
