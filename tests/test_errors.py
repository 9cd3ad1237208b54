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


def test_an_unknown_name_where_there_are_none_says_so():
    assert str(errors.unknown_name("pendulum option", "foo", [])) == (
        "unknown pendulum option 'foo'. There is none; leave it out."
    )


def test_an_unknown_name_suggests_the_closest_and_lists_all():
    error = errors.unknown_name("environment", "pendulm", ["hopper", "pendulum"])
    assert isinstance(error, errors.UnknownNameError)
    assert str(error) == (
        "unknown environment 'pendulm'. Did you mean 'pendulum'? Allowed: hopper, pendulum."
    )


def test_a_name_like_no_other_gets_no_suggestion():
    text = str(errors.unknown_name("method", "zzz", iter(["tmcl", "pets"])))
    assert text == "unknown method 'zzz'. Allowed: pets, tmcl."
