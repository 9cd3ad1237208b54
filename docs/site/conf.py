"""How `make docs` builds the site. Sphinx reads this file; its source folder is the repository."""

import importlib.metadata
import sys
import typing
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

# jaxtyping and Equinox look for this, and show `Float[Array, "env obs"]` as it is written.
typing.GENERATING_DOCUMENTATION = "headway"  # pyright: ignore

project = "Headway"
author = "The Headway developers"
release = version = importlib.metadata.version("headway")
html_title = f"{project} {release}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "headway_docs"]

# Pages stay where they are, so that links between them are the same here and on a code host.
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "docs/**.rst", "results/**.md"]
exclude_patterns = [".*", "site", "build", "src", "tests", "benchmarks", "runs"]

# Markdown as code hosts read it; headings have anchors down to the sixth level.
myst_heading_anchors = 6
highlight_language = "text"

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_maximum_signature_line_length = 80

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["style.css"]
html_copy_source = html_show_sourcelink = False
html_show_copyright = html_show_sphinx = False
