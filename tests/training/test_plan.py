"""A run's plan: whole updates within the budget, and events spread evenly over them."""

import pytest
from hypothesis import given, strategies as st

from purerl.ppo.config import Config, Evaluation
from purerl.training.plan import evenly, make_plan

UPDATES, EVERY, EVENTS = st.integers(1, 5000), st.integers(1, 300), st.integers(0, 200)


@pytest.mark.parametrize(
    ("number", "updates", "every", "expected"),
    [
        (7, 20, 1, (3, 6, 9, 12, 15, 18, 20)),
        (3, 20, 9, (9, 18, 20)),
        (50, 20, 9, (9, 18, 20)),  # there are no more chunks
        (1, 20, 4, (20,)),
        (0, 20, 4, ()),
    ],
)
def test_events_by_hand(number, updates, every, expected):
    assert evenly(number, updates, every) == expected


@given(EVENTS, UPDATES, EVERY)
def test_events_are_at_ends_of_chunks_and_the_last_is_the_runs(number, updates, every):
    events = evenly(number, updates, every)
    assert len(events) <= number and list(events) == sorted(set(events))
    assert all(0 < event <= updates for event in events)
    assert all(event % every == 0 or event == updates for event in events)
    assert events[-1:] == ((updates,) if number else ())


@given(st.data())
def test_events_between_single_updates_are_all_there_and_as_far_apart(data):
    updates = data.draw(UPDATES)
    number = data.draw(st.integers(1, min(updates, 200)))
    events = evenly(number, updates, 1)
    gaps = {after - before for before, after in zip((0, *events), events, strict=False)}
    assert len(events) == number and max(gaps) - min(gaps) <= 1


@given(st.integers(1, 64), st.integers(1, 50), UPDATES, st.integers(0, 3199), EVENTS, EVENTS, EVERY)
def test_a_plan_takes_whole_updates_and_never_more_steps_than_asked(
    envs, length, updates, rest, evaluations, checkpoints, log_every
):
    rest %= envs * length
    config = Config(
        num_steps=envs * length * updates + rest, num_envs=envs, rollout_length=length,
        num_minibatches=1,
    )  # fmt: skip
    plan = make_plan(config, Evaluation(number=evaluations), checkpoints, log_every - 1)
    assert (plan.updates, plan.steps) == (updates, config.num_steps - rest)
    assert 1 <= plan.log_every <= updates
    assert plan.checkpoints[-1] == updates  # a run that is done can always be read
    for events, asked in ((plan.evaluations, evaluations), (plan.checkpoints, max(checkpoints, 1))):
        assert len(events) <= asked and all(0 < event <= updates for event in events)
