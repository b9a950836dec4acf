"""Configuration of the documentation: `sphinx-build -W -b html docs docs/_build/html`."""

import gc
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

from rbpf import __version__  # noqa: E402

# All pages are held until the end: to look for garbage among them as often as Python does takes a third of the time.
gc.set_threshold(50_000, 1_000)

project = "rbpf"
copyright = "The rbpf authors"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "from_code",
    "mathml",
    "plain_docstrings",
    "short_signatures",
]
exclude_patterns = ["_build", "_ext"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Docstrings write `name` for code, as the source code does everywhere.
default_role = "code"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 90

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"rbpf {version}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
