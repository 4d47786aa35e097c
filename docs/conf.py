"""Sphinx configuration."""

from pdcorrect import __version__

project = "pdcorrect"
author = "The pdcorrect authors"
copyright = "2026, the pdcorrect authors"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "description"
autodoc_mock_imports: list[str] = []
html_theme = "furo"
html_title = f"pdcorrect {version}"
exclude_patterns = ["_build"]
