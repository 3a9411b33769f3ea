"""Settings of the wrong kind, which Python itself does not notice, are refused by name."""

import dataclasses
import enum
from dataclasses import dataclass

import pytest

from purerl.core.errors import UserError
from purerl.experiment import objects, settings_json
from purerl.experiment.kinds import fits, wrong_value
from purerl.experiments import cartpole_swingup
from purerl.tune import overrides

EXPERIMENT = cartpole_swingup.experiment


def changed(part, **settings):
    return dataclasses.replace(
        EXPERIMENT, **{part: dataclasses.replace(getattr(EXPERIMENT, part), **settings)}
    )


@pytest.mark.parametrize(
    ("experiment", "told"),
    [
        (changed("ppo", num_epochs=2.5), "ppo.num_epochs is 2.5; it must be a whole number."),
        (changed("ppo", num_envs=True), "ppo.num_envs is True; it must be a whole number."),
        (changed("ppo", num_steps=1e5), "ppo.num_steps is 100000.0; it must be a whole number."),
        (changed("evaluation", number=2.5), "evaluation.number is 2.5; it must be a whole number."),
        (
            changed("network", policy_hidden=64),
            "network.policy_hidden is 64; it must be a tuple, each part a whole number.",
        ),
        (
            changed("network", value_hidden=(64, 8.0)),
            "network.value_hidden is (64, 8.0); it must be a tuple, each part a whole number.",
        ),
        (
            changed("network", std="both"),
            "network.std is 'both'; it must be 'learned' or 'state'.",
        ),
        (dataclasses.replace(EXPERIMENT, seed="2"), "seed is '2'; it must be a whole number."),
        (dataclasses.replace(EXPERIMENT, seed=None), "seed is None; it must be a whole number."),
    ],
)
def test_a_value_of_the_wrong_kind_is_told_and_never_trained(experiment, told):
    assert wrong_value(experiment) == told
    with pytest.raises(UserError, match="The experiment's "):
        objects.build(experiment)


def test_a_text_for_a_number_is_told_by_its_setting():
    with pytest.raises(ValueError, match="learning_rate is '3e-4'; it must be a number above 0"):
        changed("ppo", learning_rate="3e-4")


class Ground(enum.Enum):
    SAND = 1
    ICE = 2


@dataclass(frozen=True)
class OnGround:
    ground: Ground = Ground.SAND


def test_an_enumeration_is_a_setting_by_its_names():
    words = settings_json.to_json(OnGround(Ground.ICE))
    assert words == {"ground": "ICE"}
    assert settings_json.from_json(OnGround(), words) == OnGround(Ground.ICE)
    assert fits(Ground, "ICE") and not fits(Ground, "MUD") and not fits(Ground, 2)
    assert overrides.option_words("env.ground", Ground.SAND, Ground.ICE) == ["--env.ground", "ICE"]


@dataclass(frozen=True)
class Inner:
    gaps: tuple[float, float] = (0.1, 0.2)


@dataclass(frozen=True)
class Options:
    frequency: float = 4.0
    limit: int | None = None
    inner: Inner = Inner()
    name: str = "one"
    switch: bool = False


@pytest.mark.parametrize(
    "options",
    [Options(frequency=4), Options(limit=3), Options(inner=Inner([1, 2])), Options(switch=True)],
)
def test_what_fits_passes(options):
    assert wrong_value(options) == ""


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (Options(frequency="4"), "frequency is '4'; it must be a number."),
        (Options(limit=3.5), "limit is 3.5; it must be int | None."),
        (Options(inner=Inner((1.0,))), "inner.gaps is (1.0,); it must be tuple[float, float]."),
        (Options(name=1), "name is 1; it must be a text."),
        (Options(switch="no"), "switch is 'no'; it must be True or False."),
    ],
)
def test_a_persons_own_settings_are_checked_too(options, named):
    assert wrong_value(options) == named


def test_a_setting_without_an_annotation_is_named():
    """Python makes no field of it, and the command line would have no option."""

    @dataclass(frozen=True)
    class Options:
        reach: float = 1.0
        width = 0.05
        LIMIT = 3

    told = wrong_value(dataclasses.replace(EXPERIMENT, env=Options()))
    assert told == "env.width has no annotation, so it is no setting: write `width: float`, say."
