"""Errors teach in one line, and are of the built-in kind that callers expect."""

import pytest

from headway import errors


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (errors.ConfigError, ValueError),
        (errors.UnknownNameError, KeyError),
        (errors.BadEnvironmentError, RuntimeError),
        (errors.RunError, RuntimeError),
        (errors.DivergenceError, ArithmeticError),
    ],
)
def test_every_error_is_a_headway_error_and_a_builtin_one(kind, builtin):
    assert issubclass(kind, errors.HeadwayError)
    assert issubclass(kind, builtin)
    assert str(kind("one line")) == "one line"


@pytest.mark.parametrize(
    ("kind", "got", "names", "text"),
    [
        ("option", "foo", [], "unknown option 'foo'. There is none; leave it out."),
        ("method", "zzz", ["tmcl", "pets"], "unknown method 'zzz'. Allowed: pets, tmcl."),
        ("env", "peg", ["x", "peg2"], "unknown env 'peg'. Did you mean 'peg2'? Allowed: peg2, x."),
    ],
)
def test_an_unknown_name_lists_all_and_suggests_the_closest(kind, got, names, text):
    error = errors.unknown_name(kind, got, iter(names))
    assert isinstance(error, errors.UnknownNameError)
    assert str(error) == text
