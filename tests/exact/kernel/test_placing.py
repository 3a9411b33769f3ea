"""Where and when values are computed: levels, memory, what is computed before a loop."""

import re
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from purerl import exact
from purerl.exact import traces
from purerl.exact.kernel import levels, memory, parts, reading, schedule, statements, values
from purerl.exact.kernel.statements import Statement
from tests.exact.kernel import by_one_lane, by_warps, needs_compiler

X = np.ones(9, np.float32)


def statement(size, *needs, waits=True):
    value = values.Held((size,), "f", values.Block("top"))
    reads = {x for need in needs for x in need.writes}
    return types.SimpleNamespace(writes=[value], reads=lambda: reads, waits=waits)


@pytest.mark.parametrize("seed", range(5))
def test_a_statement_comes_after_all_that_it_reads(seed):
    rng, made = np.random.default_rng(seed), []
    for _ in range(30):
        needs = rng.choice(len(made), min(len(made), int(rng.integers(3))), replace=False)
        made.append(
            statement(int(rng.integers(1, 50)), *(made[i] for i in needs), waits=rng.random() < 0.8)
        )
    level_of = {}
    found = levels.levels_of(made, set(made[3].writes))
    for number, level in enumerate(found):
        level_of |= {x.writes[0]: number for x in level}
    assert len(level_of) == len(made) and all(found)
    assert all(level_of[x] < level_of[s.writes[0]] for s in made for x in s.reads())


def test_large_values_that_can_wait_do():
    small = [statement(1)]
    for _ in range(4):
        small.append(statement(1, small[-1]))
    waits, other = statement(100, small[0]), statement(100, small[0], waits=False)
    reader, last = statement(1, other, waits=False), statement(1, small[-1], waits)
    found = levels.levels_of([*small, waits, other, reader, last], set())
    assert other in found[1] and waits in found[4] and last in found[5]


def looping(x):
    y, z = jnp.sin(x), jnp.cos(x)

    def body(_, c):
        early = jnp.sort(c[1])
        a = jnp.sort(c[0] + y + early)
        return jnp.sort(jnp.sort(a[::-1] * a) + a.sum()) * 0.1, early

    return lax.fori_loop(0, 3, body, (x, z))[0]  # the rest of the carry is read in the loop alone


def planned(function, *example):
    program = reading.read(jax.make_jaxpr(function)(*example))
    scheduler = schedule.Scheduler(program)
    clock = memory._Clock()
    for value in program.inputs:
        clock.write([value])
    clock.run(scheduler.plan)
    return program, scheduler, clock


def test_a_loop_needs_what_it_reads_and_carries_until_it_ends():
    _, scheduler, clock = planned(looping, X)
    every = [x for level in scheduler.plan.levels for x in level]
    (loop,) = [x for x in every if isinstance(x, statements.StepStatement)]
    inner = [x for plan in loop.plans for level in plan.levels for s in level for x in s.writes]
    assert len(inner) > 5 and len(loop.plans[-1].outside) > 1
    for value in {*loop.plans[-1].outside, *loop.writes}:
        assert clock.first[value] < min(clock.first[x] for x in inner)
        assert clock.last[value] > max(clock.last[x] for x in inner)


def kept_of(function, *example):
    """Returns the operations whose numbers stand in memory, and how many of them do."""
    _, scheduler, _ = planned(function, *example)
    return {(value.op, len(row.places)) for value, row in scheduler.keep.items()}


LONG = np.linspace(0.1, 1, 40).astype(np.float32)


def test_what_one_statement_computes_once_is_not_kept():
    assert kept_of(lambda x: (y := jnp.sin(x)) * jnp.cos(y), LONG) == {("mul", 40)}
    apart = kept_of(lambda x: (jnp.cos(jnp.sin(x)[:20]), jnp.exp(jnp.sin(x)[20:])), LONG)
    assert apart == {("cos", 20), ("exp", 20)}
    assert ("sin", 40) in kept_of(lambda x: jnp.sin(x) * jnp.sin(x)[::-1], LONG), "twice"


def test_of_what_two_statements_read_only_what_they_read_is_kept():
    def function(x):
        y = jnp.sin(x)
        return jnp.cos(y[:30]), jnp.exp(y[10:30]), jnp.cos(y[::-1])[10:] + 1

    assert kept_of(lambda x: function(x)[:2], LONG) == {("sin", 30), ("cos", 30), ("exp", 20)}
    assert ("sin", 30) in kept_of(function, LONG)


BAND = np.abs(np.subtract.outer(np.arange(60), np.arange(60))) < 3


def masked(x):
    y = jnp.sin(x[:, None] + x) * BAND  # its square and its products would all be computed anew
    solved = jax.scipy.linalg.solve_triangular(y + 9 * np.eye(60, dtype=np.float32), x, lower=True)
    return (
        y @ y,
        jnp.cos(y)[::2].sum(),
        solved,
        jax.lax.dynamic_slice(2 * y, (jnp.int32(50 * x[0]), 0), (1, 60)),
    )


def test_of_a_wide_map_only_what_is_chosen_is_computed_beside_what_chooses():
    def function(x):
        products = x[:, None] * x
        wide = jnp.stack([jnp.sin(products), jnp.cos(products)], -1)  # [40, 40, 2]
        best = jnp.tanh(wide[..., 0] * wide[..., 1]).argmin(1)
        return jax.vmap(lambda row, i: row[i])(wide, best)

    found = kept_of(function, LONG)
    assert {one for one in found if one[1] > 40} == {("tanh", 1600)}
    assert {("sin", 40), ("cos", 40)} < found


def test_numbers_that_are_equal_are_computed_once():
    def function(x):
        pairs = jnp.cos(jnp.tile(x[:10], 8) * 2.0)  # eight pairs with the same box
        return jnp.sin(pairs) * jnp.concatenate([x, x[::-1]]), jnp.exp(pairs)

    assert {size for op, size in kept_of(function, LONG) if op in ("cos", "exp", "sin")} == {10}


def test_the_parts_of_a_stack_do_not_stand_in_memory_to_be_read_once():
    def function(x):
        stack = jnp.stack([jnp.sin(x), jnp.cos(x), x * x]) * x[::-1]
        return stack.sum(1), (stack[::-1] * x).sum(1)

    x = np.linspace(0.1, 1, 100).astype(np.float32)
    assert {op for op, size in kept_of(function, x) if size >= 100} == {"mul"}


def test_what_is_multiplied_by_known_zeros_alone_is_not_computed():
    def function(x):
        other = jnp.sin(x[:, None] + x[::-1])
        y = jnp.exp(other) * BAND
        return y @ y, jnp.cos(y)[::2].sum(), y[3] * other[3, 5]

    found = kept_of(function, np.linspace(0.1, 1, 60).astype(np.float32))
    assert {("mul", BAND.sum()), ("sin", BAND.sum())} < found


@needs_compiler
def test_known_zeros_of_a_large_value_take_no_memory(tmp_path):
    x = np.linspace(0.1, 1, 60).astype(np.float32)
    assert ("mul", BAND.sum()) in kept_of(masked, x)
    kernel = exact.compile_kernel(masked, x)
    one = by_one_lane(kernel.text, x[None])
    wanted = jax.tree.leaves(masked(x))
    assert all(np.allclose(a, np.ravel(b), 1e-4, 1e-6) for a, b in zip(one, wanted, strict=True))
    warps = by_warps(kernel.text, x[None], folder=tmp_path, environments=1)
    assert all(
        (a.view(np.int32) == b.view(np.int32)).all() for a, b in zip(one, warps, strict=True)
    )


def test_a_linear_system_whose_result_is_needed_late_waits():
    def function(x):
        solved = lambda a, b: jax.scipy.linalg.solve_triangular(a, b, lower=True)  # noqa: E731
        factor = lambda x: jnp.linalg.cholesky(jnp.outer(x, x) + np.eye(16))  # noqa: E731
        first = factor(x)
        return solved(first, jnp.sort(jnp.sort(solved(factor(2 * x), x))))

    _, scheduler, clock = planned(function, np.ones(16, np.float32))
    steps = [x for level in scheduler.plan.levels for x in level if not isinstance(x, Statement)]
    ends = [x.writes[0] for x in steps if x.step.op == "cholesky"]
    first, second = sorted((clock.first[x], clock.last[x]) for x in ends)
    assert first[1] < second[0], "one is no longer needed when the other is made"


def test_values_that_are_needed_at_once_do_not_share_memory():
    program, scheduler, clock = planned(looping, X)
    address, size = memory.placed(scheduler, program.inputs)
    spans = clock.spans()
    for i, one in enumerate(spans):
        at = address[one.values[0]]
        assert len(scheduler.slots) <= at and at + one.size <= size
        for other in spans[:i]:
            there = address[other.values[0]]
            apart = at + one.size <= there or there + other.size <= at
            assert apart or one.last < other.first or other.last < one.first
    assert size < sum(span.size for span in spans), "some memory is used again"


def test_what_is_read_and_what_is_written_in_one_level_do_not_share_memory():
    times = [(0, 2), (2, 3), (3, 4)]
    spans = [memory._Span([], 4, *when) for when in times]
    assert memory._first_fit(spans, np.arange(3), 1) == (9, [1, 5, 1])


def text_of(function):
    return exact.compile_kernel(function, X).text.body


def test_what_does_not_change_in_a_loop_is_computed_before_it():
    text = text_of(lambda x: lax.fori_loop(0, 3, lambda i, c: c * jnp.sin(x), x))
    assert text.index("sinf") < text.index("REPEAT(")


def test_a_branch_keeps_what_it_alone_computes():
    text = text_of(lambda x: lax.cond(x[0] > 0, lambda: jnp.sin(x), lambda: x))
    assert text.index("which <= 0") < text.index("sinf")


def test_all_warps_of_a_block_wait_only_where_all_make_the_same_rounds():
    def newton(x):
        x = lax.while_loop(
            lambda c: c.sum() > 1, lambda c: lax.fori_loop(0, 2, lambda _, d: d * 0.5, c), x
        )
        return lax.fori_loop(0, 3, lambda _, c: jnp.sin(c), x)

    text = text_of(newton)
    begin, end = text.index("for (;;)"), text.rindex("REPEAT(")
    assert "LOCKSTEP" not in text[begin:end].rsplit("}", 1)[0]
    assert "LOCKSTEP" in text[:begin] and "LOCKSTEP" in text[end:]


def rounds(read):
    """Five rounds that carry what no later round reads, and a number that is read only if asked."""

    def body(c, _):
        y, seen, number = c
        y = 0.9 * jnp.sin(y) + (0.1 * seen.sum() if read else 0.0)
        small = lax.while_loop(lambda z: z.sum() > 1.0, lambda z: 0.5 * z, jnp.exp(y))
        return (y, jnp.cos(small) + small[::-1], number + 1), None

    return lambda x: lax.scan(body, (x, jnp.zeros(9), jnp.int32(0)), None, 5)[0]


@needs_compiler
@pytest.mark.parametrize("read", [False, True])
def test_what_no_later_round_reads_is_computed_in_the_last_one_alone(read, tmp_path):
    kernel = exact.compile_kernel(rounds(read), X)
    before, _, last = kernel.text.body.partition("if (round1 == 4) {")
    assert ("expf" in before) == read and ("expf" in last) != read and "sinf" in before
    one = by_one_lane(kernel.text, X[None])
    wanted = jax.tree.leaves(jax.jit(rounds(read))(X))
    assert all(np.allclose(a, np.ravel(b), 1e-5, 1e-6) for a, b in zip(one, wanted, strict=True))
    warps = by_warps(kernel.text, X[None], folder=tmp_path, environments=1, warps=3)
    assert all(
        (a.view(np.int32) == b.view(np.int32)).all() for a, b in zip(one, warps, strict=True)
    )


def iterations(after):
    """Rounds that carry a matrix, which the next round alone reads, or what comes after, too."""

    def body(c):
        y, matrix, number = c
        y = 0.7 * jnp.sin(y) + 0.1 * matrix.sum(0)
        away = jnp.abs(y[:, None] - y)
        return y, jnp.exp(-away) / (1.0 + away) - jnp.tanh(away), number + 1

    def run(x):
        goes_on = lambda c: (c[2] < 5) & (c[0].sum() < 20.0)  # noqa: E731
        y, matrix, number = lax.while_loop(goes_on, body, (x, jnp.zeros((9, 9)), jnp.int32(0)))
        return (y, number, matrix) if after else (y, number)

    return run


@needs_compiler
@pytest.mark.parametrize("after", [False, True])
def test_what_only_a_next_round_reads_is_not_computed_in_the_last_one(after, tmp_path):
    kernel = exact.compile_kernel(iterations(after), X)
    before, _, then = kernel.text.body.partition("else  {")
    assert ("expf" in before) == after and ("expf" in then) != after and "sinf" in before
    xs = np.stack([X, 0.1 * X, 9.0 * X])  # the last makes no round at all
    one = by_one_lane(kernel.text, xs)
    wanted = jax.tree.leaves(jax.jit(jax.vmap(iterations(after)))(xs))
    assert len({*wanted[1].tolist()}) > 1, "each makes as many rounds as it needs"
    for found, right in zip(one, wanted, strict=True):
        np.testing.assert_allclose(found, np.reshape(right, found.shape), 1e-5, 1e-6)
    warps = by_warps(kernel.text, xs, folder=tmp_path, environments=3, warps=2)
    assert all(
        (a.view(np.int32) == b.view(np.int32)).all() for a, b in zip(one, warps, strict=True)
    )


def signs(same):
    """Rounds that carry numbers and which of them are below 0; at first, that of these or not."""

    def body(c):
        y, below, number = c
        y = jnp.cos(3.0 * y) - 0.3 + 0.1 * jnp.where(below, y, 1.0).sum()
        return y, y < 0.0, number + 1

    def run(x):
        x = jnp.outer(x, jnp.linspace(-1.0, 1.0, 32)).reshape(-1)
        begun = x, x < 0.0 if same else x < 0.1, jnp.int32(0)
        return lax.while_loop(lambda c: (c[2] < 4) & (c[0].sum() > -1e3), body, begun)

    return run


@needs_compiler
@pytest.mark.parametrize("same", [True, False])
def test_what_follows_from_the_carry_is_not_carried(same):
    kernel = exact.compile_kernel(signs(same), X)
    assert (kernel.text.memory < 3 * 288) == same, "not the signs beside the numbers of two rounds"
    xs = np.stack([X, 0.1 * X])
    wanted = jax.tree.leaves(jax.jit(jax.vmap(signs(same)))(xs))
    for found, right in zip(by_one_lane(kernel.text, xs), wanted, strict=True):
        np.testing.assert_allclose(found, np.reshape(right, found.shape), 1e-4, 1e-4)


def test_a_trace_in_two_parts_computes_what_it_did():
    def whole(a, b):
        c = jnp.sin(a)
        d = jnp.dot(c, b)
        return c, d + a, jnp.cos(c).sum(), 3.0, b

    closed = jax.make_jaxpr(whole)(X, X)
    first, second = traces.split(closed, [True, False, True, False, False])
    assert [x.primitive.name for x in second.jaxpr.eqns if x.primitive.name == "dot_general"]
    assert not [x for x in first.jaxpr.eqns if x.primitive.name == "dot_general"]
    way = traces.bind_equation, lambda x, _: x
    c, cosine, three, same, *taken = traces.evaluate(first, *way, X, X)
    (sum_,) = traces.evaluate(second, *way, X, X, *taken)
    for found, right in zip((c, sum_, cosine, three, same), whole(X, X), strict=True):
        np.testing.assert_array_equal(found, right)


def test_what_stands_between_branches_is_cut_into_functions_that_know_its_names():
    """Free. Called in their places they do what the lines did, in their order."""
    line = "ONE(0) { const float x = P[1]; P[2] = x; }"
    copied, tested = (
        "FEW(0, i, 4) { P[i] = in0[e*4+i]; }",
        "int which; { which = 1; } if (!which) break;",
    )
    lines = [
        copied,
        *[line] * 1500,
        "for (;;) {",
        tested,
        line,
        "SYNC;",
        "}",
        *[line, "LOCKSTEP;"] * 60,
        "END }",
    ]
    routines, kept = parts.in_parts(lines)
    again = []
    for one in kept:
        number = re.match(r"part(\d+)\(P, thread\);", one)
        again += routines[int(number[1])].splitlines()[1:-1] if number else [one]
    assert again == lines and len(kept) < 40
    for number, routine in enumerate(routines):
        assert routine.startswith(f"PART(part{number})\n") and len(routine) < 1.05 * parts.MOST
        assert "in0" not in routine and "which" not in routine
