"""Pages stand where a code host shows them; the site adds what it needs while reading them."""

import shutil
from pathlib import Path

from docutils import nodes
from sphinx import addnodes

NAVIGATION = Path(__file__).parent.parent / "navigation.txt"
BELOW = "\n```{toctree}\n:hidden:\n:glob:\n\n*/**\n```\n"


def complete(app, docname: str, source: list[str]) -> None:
    """Append the contents to the first page and to that of the results; add missing titles."""
    if docname == app.config.root_doc:
        source[0] += "\n" + NAVIGATION.read_text()
    elif docname == "results/README":
        source[0] += BELOW
    elif docname.startswith("results/") and not source[0].startswith("# "):
        source[0] = f"# {docname.removeprefix('results/')}\n\n{source[0]}"


def unlink_folders(app, document: nodes.document) -> None:
    """Show a link to a folder of the repository, which is no page, as the text it has."""
    page = Path(document["source"])
    for link in list(document.findall(addnodes.pending_xref)):
        if link["reftype"] == "myst" and (page.parent / link["reftarget"]).is_dir():
            link.replace_self(link.children)


def add_index(app, exception: Exception | None) -> None:
    """Let the address of the site open the first page."""
    if exception is None and app.builder.name == "html":
        shutil.copy(app.outdir / f"{app.config.root_doc}.html", app.outdir / "index.html")


def setup(app) -> None:
    """Connect to Sphinx."""
    app.connect("source-read", complete)
    app.connect("doctree-read", unlink_folders)
    app.connect("build-finished", add_index)
