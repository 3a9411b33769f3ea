"""What XLA cannot compile with Triton's reductions is compiled without them. Costs 1 s."""

import jax
import jax.numpy as jnp
import pytest

from purerl.devices.compilation import compiled
from purerl.exact import TRITON_REDUCTIONS


class Lowered:
    """A program of which XLA says something."""

    def __init__(self, words):
        self.words, self.asked = words, []

    def compile(self, compiler_options=None):
        self.asked.append(compiler_options)
        if compiler_options is None:
            raise jax.errors.JaxRuntimeError(self.words)
        return "a program"


def test_what_has_no_triton_reduction_is_compiled_without():
    lowered = Lowered("UNIMPLEMENTED: Dimension bounds are not divisible by tile size")
    assert compiled(lowered) == "a program"
    assert lowered.asked == [None, {TRITON_REDUCTIONS: False}]


def test_any_other_error_is_the_users():
    lowered = Lowered("RESOURCE_EXHAUSTED: Out of memory")
    with pytest.raises(jax.errors.JaxRuntimeError, match="Out of memory"):
        compiled(lowered)
    assert lowered.asked == [None]


def test_this_xla_knows_the_option():
    lowered = jax.jit(lambda x: jnp.tanh(x).sum()).lower(jnp.ones(8))
    program = lowered.compile(compiler_options={TRITON_REDUCTIONS: False})
    assert program(jnp.ones(8)) == compiled(lowered)(jnp.ones(8))
