"""Sphinx configuration: ``sphinx-build -W docs build/docs``."""

from varpin import __version__

project = "varpin"
author = "The varpin developers"
copyright = "the varpin developers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx_copybutton"]
html_theme = "furo"
html_title = f"varpin {version}"
html_static_path = ["_static"]
html_css_files = ["varpin.css"]
exclude_patterns = ["build"]

napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Main args", "params_style"), ("Other Args", "params_style")]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "both"
myst_heading_anchors = 3
