"""What the site adds to Sphinx: pages of the repository as they stand, settings, commands."""

from headway_docs import commands, docstrings, pages, references, settings


def setup(app) -> dict[str, bool]:
    """Called by Sphinx."""
    for part in (commands, docstrings, pages, references, settings):
        part.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
