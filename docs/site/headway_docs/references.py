"""Names that are written in text or in annotations lead to where the reference has them."""

import re
from collections.abc import Iterator

from docutils import nodes
from sphinx import addnodes
from sphinx.util.nodes import make_refnode

SECTIONS = "model|fitting|planner|collection|evaluation"
SETTING = re.compile(rf"(?:--)?((?:{SECTIONS})\.[a-z_-]+)(?:[= ].*)?")
LINKS = nodes.title | nodes.reference | addnodes.pending_xref  # need none, or are one
NAME = re.compile(r"(headway\.[\w.]+)(?:\(.*\))?")
COMMAND = re.compile(r"headway ([a-z-]+)(?: .*)?")


def goal(code: str) -> dict[str, str] | None:
    """Where a piece of code in a text leads: to a setting, a public name, or a command."""
    if setting := SETTING.fullmatch(code):
        return {"refdomain": "py", "reftype": "obj", "reftarget": setting[1].replace("-", "_")}
    if name := NAME.fullmatch(code):
        return {"refdomain": "py", "reftype": "obj", "reftarget": name[1]}
    if command := COMMAND.fullmatch(code):
        return {"refdomain": "", "reftype": "command", "reftarget": f"command-{command[1]}"}
    return None


def link_mentions(app, document: nodes.document) -> None:
    """Link `planner.horizon`, `headway.train(...)` and `headway train ENV` in the guides."""
    for code in list(document.findall(nodes.literal)):
        where = goal(code.astext())
        if where is None or isinstance(code.parent, LINKS):
            continue
        link = addnodes.pending_xref("", refdoc=app.env.docname, **where)
        code.replace_self(link)
        link += code


def places(target: str, known: dict) -> Iterator[str]:
    """Documented names that a name may stand for: `headway.data.Trajectory`, `Optimizer.init`."""
    if target.startswith("headway."):
        yield f"headway.{target.rpartition('.')[2]}"
    if target[:1].isupper():
        yield from (name for name in known if name.endswith(f".{target}"))


def find_name(app, env, node: addnodes.pending_xref, content: nodes.Node) -> nodes.Node | None:
    """Resolve a command, or a name without its module or with the one that it is defined in."""
    if node["reftype"] == "command":
        page, anchor = env.domains["std"].anonlabels.get(node["reftarget"], (None, None))
        return page and make_refnode(app.builder, node["refdoc"], page, anchor, content)
    if node.get("refdomain") != "py":
        return None
    domain = env.domains["py"]
    for name in places(node["reftarget"], domain.objects):
        if name in domain.objects:
            where = (env, node["refdoc"], app.builder, "obj", name, node, content)
            return domain.resolve_xref(*where)
    return None


def setup(app) -> None:
    """Connect to Sphinx."""
    app.connect("doctree-read", link_mentions)
    app.connect("missing-reference", find_name)
