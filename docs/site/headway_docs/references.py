"""Names that are written in text or in annotations lead to where the reference has them."""

import re
from collections.abc import Iterator

from docutils import nodes
from sphinx import addnodes

SECTIONS = "model|fitting|planner|collection|evaluation"
SETTING = re.compile(rf"(?:--)?((?:{SECTIONS})\.[a-z_-]+)(?:[= ].*)?")
LINKS = nodes.title | nodes.reference | addnodes.pending_xref  # need none, or are one
NAME = re.compile(r"(headway\.[\w.]+)(?:\(.*\))?")


def named(code: str) -> str | None:
    """The setting or public name that a piece of code in a text is about."""
    setting, name = SETTING.fullmatch(code), NAME.fullmatch(code)
    if setting:
        return setting[1].replace("-", "_")
    return name[1] if name else None


def link_mentions(app, document: nodes.document) -> None:
    """Link `planner.horizon`, `--planner.horizon 20` and `headway.train(...)` in the guides."""
    for code in list(document.findall(nodes.literal)):
        target = named(code.astext())
        if target is None or isinstance(code.parent, LINKS):
            continue
        link = addnodes.pending_xref(
            "", refdomain="py", reftype="obj", reftarget=target, refdoc=app.env.docname
        )
        code.replace_self(link)
        link += code


def places(target: str, known: dict) -> Iterator[str]:
    """Documented names that a name may stand for: `headway.data.Trajectory`, `Optimizer.init`."""
    if target.startswith("headway."):
        yield f"headway.{target.rpartition('.')[2]}"
    if target[:1].isupper():
        yield from (name for name in known if name.endswith(f".{target}"))


def find_name(app, env, node: addnodes.pending_xref, content: nodes.Node) -> nodes.Node | None:
    """Resolve a name that was written without its module, or with the one it is defined in."""
    if node.get("refdomain") != "py":
        return None
    domain = env.domains["py"]
    for name in places(node["reftarget"], domain.objects):
        if name in domain.objects:
            where = (env, node["refdoc"], app.builder, "obj", name, node, content)
            return domain.resolve_xref(*where)
    return None


def shorten_defaults(app, what, name, thing, options, signature, returned) -> tuple | None:
    """Say less of defaults that a function makes."""
    return (signature.replace("<factory>", "..."), returned) if signature else None


def setup(app) -> None:
    """Connect to Sphinx."""
    app.connect("doctree-read", link_mentions)
    app.connect("missing-reference", find_name)
    app.connect("autodoc-process-signature", shorten_defaults)
