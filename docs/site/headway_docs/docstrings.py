"""Where what Sphinx reads from the library is not what a reader should see."""

BEFORE_NAPOLEON = 400  # which reads Google's sections, at 500


def tidy_signature(app, what, name, thing, options, signature, returned):
    """Say less of defaults that a function makes, and nothing of how a Protocol is called."""
    if signature is None:
        return None
    if getattr(thing, "_is_protocol", False):
        return "", returned
    return signature.replace("<factory>", "..."), returned


def tidy_field(app, what, name, thing, options, lines: list[str]) -> None:
    """Let the text of a field stand as it is.

    A named tuple says "Alias for field number 0" of its own accord. Napoleon takes what stands
    before a colon in the first line for the type.
    """
    if what in ("attribute", "property"):
        lines[:] = [""] + [line for line in lines if not line.startswith("Alias for field number")]


def setup(app) -> None:
    """Connect to Sphinx."""
    app.connect("autodoc-process-signature", tidy_signature)
    app.connect("autodoc-process-docstring", tidy_field, priority=BEFORE_NAPOLEON)
