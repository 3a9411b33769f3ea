"""Errors name the value and the fix."""

import doctest

from purerl.core import errors


def test_the_examples_are_right():
    assert doctest.testmod(errors).failed == 0 < doctest.testmod(errors).attempted


def test_an_unknown_name_is_told_with_the_nearest_and_all_there_are():
    said = errors.unknown_name("joint", "hinje", ["slide", "hinge", ""], " in this model")
    assert said == (
        "There is no joint 'hinje' in this model. Did you mean 'hinge'? There are: slide, hinge."
    )
    assert errors.unknown_name("joint", "x", []) == "There is no joint 'x'. There are: none."


def test_a_bare_message_is_told_with_its_class():
    assert errors.one_line(KeyError("x")) == "KeyError: 'x'"
    said = "A message\n  that is long enough."
    assert errors.one_line(ValueError(said)) == "A message that is long enough."
