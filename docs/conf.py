"""Sphinx configuration: ``sphinx-build -W docs build/docs``."""

import sys
from pathlib import Path

from varpin import __version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "varpin"
author = "The varpin developers"
copyright = "the varpin developers"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "sphinxarg.ext",
    "executed",
]
html_theme = "furo"
html_title = f"varpin {version}"
html_static_path = ["_static"]
html_css_files = ["varpin.css"]
smartquotes = False  # they would make a dash of the two before an option
exclude_patterns = ["build", "extensions"]
copybutton_selector = "div:not(.output) > div.highlight pre"

# Pages whose Python is run when the site is built. The others start processes, or need packages beside varpin.
executed_pages = [
    "tutorial",
    "robots",
    "scenes",
    "constraints",
    "noise",
    "custom-cost",
    "plan-constraints",
    "custom-force",
    "control-loop",
    "identification",
    "deployment",
    "pink",
    "textbook",
    "which-integrator",
    "limits",
    "extending",
]

napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Main args", "params_style"), ("Other Args", "params_style")]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "both"
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
mathjax3_config = {"chtml": {"scale": 0.92}}  # as large as the text around it
