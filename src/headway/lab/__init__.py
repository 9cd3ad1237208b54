"""Comparison of runs: tables, figures, one page, films, and the sweeps that make the runs."""

from headway.errors import needs

needs("lab", "pandas", "matplotlib", "jinja2", "imageio")
