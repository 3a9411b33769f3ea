"""The examples in the docstrings of the algorithm's public functions, from `init` onwards."""

import doctest
import functools

import jax
import pytest

import purerl.envs.cartpole_swingup  # the examples use it


@pytest.mark.slow
def test_the_examples_in_the_docstrings_hold(capsys):
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    names = {"purerl": purerl, "jax": jax, "functools": functools}
    for function in (purerl.init, purerl.update, purerl.evaluate_policy):
        (test,) = finder.find(function, globs=names)
        assert test.examples
        test.globs = names  # what one example has made, the next one uses
        runner.run(test, clear_globs=False)
    assert runner.failures == 0, capsys.readouterr().out
