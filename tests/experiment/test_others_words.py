"""Another trainer's word is answered with our setting, which exists, and is on the page named."""

import dataclasses
import re
from pathlib import Path

import pytest

from purerl import Config, Evaluation
from purerl.experiment import other_trainers

OURS = [
    f"--{group}.{field.name.replace('_', '-')}"
    for group, kind in (("ppo", Config), ("evaluation", Evaluation))
    for field in dataclasses.fields(kind)
]
PAGE = Path(__file__).parents[2] / other_trainers.PAGE


@pytest.mark.parametrize("theirs", other_trainers.OURS)
def test_each_word_has_a_setting_and_is_on_the_page(theirs):
    ours, conversion = other_trainers.OURS[theirs], other_trainers.CONVERSIONS.get(theirs, "")
    answer = other_trainers.suggest(f"--ppo.{theirs.replace('_', '-')}", OURS)
    assert re.match(rf"Did you mean --\w+\.{ours.replace('_', '-')} \(", answer)
    assert conversion in answer
    assert f"`{theirs}`" in PAGE.read_text()


def test_each_conversion_is_of_a_word():
    assert other_trainers.CONVERSIONS.keys() < other_trainers.OURS.keys()


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [("discount", "gamma"), ("num-steps-per-env", "rollout-length"), ("lam", "gae-lambda")],
)
def test_words_that_look_like_another_setting_or_none(theirs, ours):
    assert f"--ppo.{ours} " in other_trainers.suggest(f"--ppo.{theirs}", OURS)
