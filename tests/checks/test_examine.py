"""`python -m purerl.check`: a broken environment or network for each check, which finds just it."""

import dataclasses
import itertools
import re
from types import SimpleNamespace

import flax.linen as nn
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import check
from purerl.checks import check_env, examine_env, examine_network
from purerl.checks.examine_physics import check_controls, check_placed, check_ranges, check_solver
from purerl.core.env import State
from purerl.core.records import Network, Normal, PolicyOutput
from purerl.devices import memory
from purerl.devices.programs import abstract_state
from purerl.experiment import examine
from purerl.experiment.objects import build
from purerl.physics.interface import Physics
from purerl.ppo.config import Config
from purerl.ppo.networks import MlpOptions, RecurrentOptions, from_linen, mlp, recurrent
from tests.checks.test_check_env import Toy, toy_state
from tests.runs import toy_experiment
from tests.runs.toy_experiment import experiment

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_quickly")]


def bad(findings):
    """Returns what is not well, about -> text."""
    return {one.about: f"{one.level}: {one.text}" for one in findings if one.level != "ok"}


class Counting(Toy):
    def step(self, state, action):
        object.__setattr__(self, "calls", getattr(self, "calls", 0) + 1)
        return super().step(state, action)


class Deaf(Toy):
    def reset(self, key):
        return toy_state(jnp.ones(2))


class NanTerm(Toy):
    def step(self, state, action):
        term = jnp.log(-1.0 - action[0] ** 2)
        return super().step(state, action).replace(metrics={"distance": term})


class NanLate(Toy):
    """When a full action is met, the third of those that are tried."""

    def step(self, state, action):
        return super().step(state, action).replace(reward=jnp.log(1.0 - action[0]))


class NanStart(Toy):
    def reset(self, key):
        return super().reset(key).replace(reward=jnp.float32(jnp.inf))


class NumpyRandom(Toy):
    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action + 0.1 * np.random.randn())


class OverAtOnce(Toy):
    def reset(self, key):
        return super().reset(key).replace(terminated=jnp.ones((), bool))


class OneStep(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(terminated=jnp.ones((), bool))


class NoReward(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(reward=jnp.zeros(()))

    def reset(self, key):
        return super().reset(key).replace(reward=jnp.zeros(()))


def seen(position, entry):
    state = toy_state(position)
    return state.replace(observation={"policy": jnp.append(position, entry)})


@dataclasses.dataclass(frozen=True)
class Seeing(Toy):
    scale: float = 1.0
    offset: float = 0.0

    def reset(self, key):
        return self._seen(super().reset(key))

    def step(self, state, action):
        return self._seen(super().step(state, action))

    def _seen(self, state):
        return seen(state.physics, self.offset + self.scale * state.physics[0])


class HalfDeaf(Toy):
    def step(self, state, action):
        return super().step(state, action.at[1].set(0.0))


def drawn():
    """A number that the host draws anew at each call."""
    draw = np.random.default_rng().normal
    return jax.pure_callback(
        lambda: np.float32(draw()), jax.ShapeDtypeStruct((), jnp.float32), vmap_method="sequential"
    )


class OtherStart(Toy):
    def reset(self, key):
        return toy_state(jax.random.normal(key, (2,)) + drawn())


class OtherStep(Toy):
    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action + drawn())


class WrongReward(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(reward=jnp.zeros(1))


@pytest.mark.parametrize(
    ("env", "about", "text"),
    [
        (Counting(), "own state", "error: reset or step sets env.calls"),
        (Deaf(), "keys", "warning: physics, observation and task are the same"),
        (NanTerm(), "finite", "error: metrics/distance is nan after every step"),
        (
            NanLate(),
            "finite",
            "error: reward is -inf for the first time at step 3 of 23, by [1, 1];",
        ),
        (NanStart(), "finite", "error: reward is inf when reset returns; such"),
        (NumpyRandom(), "same twice", "error: step is another program when it is traced again:"),
        (OverAtOnce(), "ends", "error: 16 of 16 episodes have ended when reset returns"),
        (OneStep(), "ends", "error: every episode ends at its first step"),
        (NoReward(), "reward", "warning: it is 0 at every one of"),
        (Seeing(scale=0.0), "scale", "warning: observation/policy [2] does not vary"),
        (Seeing(offset=1e5), "scale", "warning: observation/policy [2] varies by less than 1/"),
        (Seeing(scale=1e5), "scale", "warning: observation/policy [2] has a std beyond 10000"),
        (HalfDeaf(), "actions", "warning: entries 1 of 2 change nothing in"),
        (OtherStart(), "same twice", "error:"),
        (OtherStep(), "same twice", "error:"),
        (WrongReward(), "protocol", "error: reward is float32 [] from reset and float32 [1]"),
    ],
)
def test_it_finds_just_what_is_broken(env, about, text):
    found = bad(examine_env.examine(env))
    assert list(found) == [about] and found[about].startswith(text)


@pytest.mark.parametrize(
    ("room", "level"), [(1e12, "ok"), (1.5, "warning"), (0.5, "error")], ids=["ok", "tight", "full"]
)
def test_memory_is_compared_with_what_there_is(room, level, monkeypatch):
    setup = build(experiment)
    abstract = abstract_state(*setup[:3])
    least = sum(memory.least(setup.config, abstract, setup.env.action_size).values())
    monkeypatch.setattr(memory, "room", lambda: room * least)
    found = examine.check_memory(setup, abstract)
    assert found.level == level
    assert level == "ok" or "lower" in found.text


def test_a_pixel_in_a_rollout_takes_a_byte():
    """Twice: as it was collected, and shuffled; beside an action and six numbers of float32."""
    pictures = jax.ShapeDtypeStruct((8, 2, 30, 40), np.uint8)
    state = State((), pictures, *5 * [()])
    abstract = SimpleNamespace(env_state=state, episode=(), params=(), optimizer=())
    parts = memory.least(Config(num_steps=128, num_envs=8, rollout_length=16), abstract, 3)
    assert parts["environments"] == 8 * 2 * 30 * 40
    assert parts["rollouts"] == 2 * 8 * 16 * (2 * 30 * 40 + 4 * (3 + 6))


@pytest.mark.parametrize(("number", "level"), [(1, "ok"), (2, "warning")])
def test_minibatches_of_few_samples_are_named(number, level):
    """32 steps an update: one minibatch of 32, or two of 16."""
    changed = dataclasses.replace(experiment.ppo, num_minibatches=number)
    setup = build(dataclasses.replace(experiment, ppo=changed))
    found = examine.check_minibatch(setup, abstract_state(*setup[:3]))
    assert found.level == level and f"of {32 // number} steps each" in found.text


def test_a_run_of_few_updates_and_a_setting_that_nothing_reads_are_named():
    def said(**settings):
        return bad(examine.check_settings(Config(num_envs=8, rollout_length=16, **settings)))

    assert said(num_steps=50 * 128) == {}
    assert "49 in the whole run, of 128 steps each" in said(num_steps=50 * 128 - 1)["updates"]
    assert "reads 0.02 where" in said(num_steps=6400, desired_kl=0.02)["desired_kl"]
    assert said(num_steps=6400, desired_kl=0.02, schedule="adaptive_kl") == {}
    one = said(num_steps=6400, schedule="adaptive_kl", num_epochs=1, num_minibatches=1)
    assert "its KL is 0" in one["schedule"]


def test_speed_is_measured_only_when_asked(monkeypatch):
    """By a clock of its own: what a busy machine measures says nothing of the code."""
    took = iter([0.01, 0.5, 2.0])  # a step of each, a rollout of 32 steps, an update of as many
    monkeypatch.setattr(examine, "_seconds", lambda function: (function(), next(took))[1])
    quick, timed = (list(examine.examine(experiment, speed)) for speed in (False, True))
    assert timed[: len(quick)] == quick
    told, alone, update = (one.text for one in timed[len(quick) :])
    assert told.endswith("takes 0.01 s: timing 4 takes about 0 s, and compiling")
    assert alone == "64 steps/s of the environments alone"
    assert update.startswith("16 steps/s in an update of 2.00 s: 12 updates take 0.4 min")


def test_the_command_says_what_is_checked_before_it_is_built(monkeypatch, capsys):
    said = []

    def found(chosen, speed):
        said.append(capsys.readouterr().out)
        return iter(())

    monkeypatch.setattr(examine, "examine", found)
    assert check.main([toy_experiment.__file__]) == 0
    told, waits = said[0].splitlines()
    assert told == f"toy_experiment: {toy_experiment.__doc__.strip()}"
    assert waits.startswith("Building and compiling first")
    assert capsys.readouterr().out == "toy_experiment: 0 errors, 0 warnings\n"


@dataclasses.dataclass(frozen=True)
class Pictured(Toy):
    """Notes each picture that is made."""

    made: list

    def reset(self, key):
        return self._seen(super().reset(key))

    def step(self, state, action):
        return self._seen(super().step(state, action))

    def _seen(self, state):
        def draw(_):
            self.made.append(1)
            return np.zeros((1, 4, 4), np.uint8)

        shape = jax.ShapeDtypeStruct((1, 4, 4), np.uint8)
        picture = jax.pure_callback(draw, shape, state.physics, vmap_method="sequential")
        return state.replace(observation={"policy": state.physics, "eyes": picture})


def test_what_pictures_cost_is_told_by_steps_that_make_none(monkeypatch):
    made, took = [], iter([0.01, 0.5, 0.125])  # a step of each, many, as many without pictures
    numbers = []

    def seconds(function):
        made.clear()
        jax.block_until_ready(function())
        numbers.append(len(made))
        return next(took)

    monkeypatch.setattr(examine, "_seconds", seconds)
    config = Config(num_steps=64, num_envs=4, rollout_length=8, num_minibatches=1)
    setup = SimpleNamespace(config=config, env=Pictured(made))
    told = itertools.islice(examine._speeds(setup, examine._starts(setup, 4)), 3)
    assert [one.text for one in told][2] == "75% of that are pictures: 11719 us for those of a step"
    assert numbers == [4, 4 * 8, 0]


def test_the_shorter_time_of_two_counts_and_not_the_first(monkeypatch):
    clock = iter([0.0, 1.0, 10.0, 15.0, 20.0, 23.0])  # 1 s, 5 s, 3 s
    monkeypatch.setattr(examine, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    assert examine._seconds(lambda: 0) == 3.0


def test_it_finds_nothing_in_a_good_one():
    assert not bad(examine_env.examine(Toy())) and not bad(examine_env.examine(Seeing()))


def test_a_start_shows_what_it_can():
    def starts(env):
        return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))

    assert not examine_env.first_state(starts(Toy()))
    both = jax.tree.map(lambda x: jnp.stack([x, x]), starts(Deaf()))  # vmapped seeds
    assert list(bad(examine_env.first_state(both))) == ["keys"]
    assert "4 of 4" in bad(examine_env.first_state(starts(OverAtOnce())))["ends"]


XML = """<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size="0.1"/></body>
<body name="goal" mocap="true" pos="1 0 0"><geom size="0.1"/></body></worldbody>
<actuator><motor name="push" joint="slide" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>"""


@dataclasses.dataclass(frozen=True)
class Pushed(Toy):
    """A body and a goal."""

    physics: Physics
    strength: float = 1.0
    late: bool = False
    action_size = 1

    def reset(self, key):
        goal = jax.random.normal(key, (2, 3))
        start = (jnp.zeros(1), jnp.zeros(1))
        place = {"body_pos": jnp.zeros((3, 3)).at[2].set(goal[1])}
        physics, readings = self.physics.init(*start, place)
        if self.late:
            physics = physics.replace(mocap_pos=goal[:1])
        return toy_state(readings.xpos[2, :2]).replace(physics=physics)

    def step(self, state, action):
        physics, readings = self.physics.step(state.physics, self.strength * action)
        return toy_state(readings.xpos[2, :2]).replace(physics=physics)


def pushed(**how):
    return Pushed(physics=Physics(mujoco.MjModel.from_xml_string(XML), ("xpos",)), **how)


@pytest.mark.parametrize(("strength", "found"), [(1.0, False), (2.0, True)])
def test_controls_beyond_the_range(strength, found):
    env = pushed(strength=strength)
    keys = jax.random.split(jax.random.key(0), 2)
    actions = jnp.linspace(-1.0, 1.0, 6).reshape(3, 2, 1)
    trial = SimpleNamespace(start=jax.vmap(env.reset)(keys), actions=actions)
    said = bad(check_controls(env, trial))
    assert bool(said) == found
    assert not found or "push gets -2 to 2, and has -1 to 1" in said["controls"]
    assert "step" not in vars(env.physics), "left as it was"


@pytest.mark.parametrize("late", [False, True])
def test_a_goal_that_is_placed_late(late):
    said = bad(check_placed(pushed(late=late)))
    assert bool(said) == late
    assert not late or 'by init\'s changes={"body_pos": ...}' in said["placing"]


BALL = """<mujoco><compiler angle="{angle}"/><worldbody><geom type="plane" size="1 1 .1"/>
<body pos="0 0 .1"><freejoint/><geom size=".1"/></body>
<body pos="0 0 1"><joint name="arm" range="{range}"/><geom type="capsule" size=".1 .5"/></body>
</worldbody><actuator><motor name="push" joint="arm" ctrlrange="-1 1"/></actuator></mujoco>"""


@dataclasses.dataclass(frozen=True)
class Balls(Toy):
    """A ball on the floor, and an arm."""

    physics: Physics
    turned: bool = True
    action_size = 1

    def reset(self, key):
        start = jnp.asarray(self.physics.model.qpos0) * (1.0 if self.turned else 0.0)
        physics, _ = self.physics.init(start, jax.random.normal(key, (7,)))
        return toy_state(physics.qpos[:2]).replace(physics=physics)

    def step(self, state, action):
        physics, _ = self.physics.step(state.physics, action)
        return toy_state(physics.qpos[:2]).replace(physics=physics)


def balls(angle="radian", range="-1 1", iterations=100, solver="CG", **how):  # noqa: A002
    model = mujoco.MjModel.from_xml_string(BALL.format(angle=angle, range=range))
    solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver}")
    model.opt.solver, model.opt.iterations = solver, iterations
    return Balls(physics=Physics(model, (), 5, "c"), **how)


@pytest.mark.parametrize(
    ("solver", "iterations", "found"), [("CG", 100, False), ("CG", 1, True), ("NEWTON", 1, True)]
)
def test_a_solver_that_does_not_converge(solver, iterations, found):
    env = balls(iterations=iterations, solver=solver)
    said = list(check_solver(env, check_env.try_out(env, 4, 5)))
    assert [one.about for one in said] == ["solver"]
    assert (said[0].level == "warning") == found
    assert f"by {iterations} iterations (50 of line search)" in said[0].text
    assert ("or take Newton" in said[0].text) == (found and solver == "CG")


@pytest.mark.parametrize(
    ("angle", "limits", "said"),
    [
        ("degree", "-2.6 2.6", "joint arm turns by 0.0454 rad at most.* written in radians"),
        ("radian", "-150 10", "joint arm turns by 150 rad at most.* written in degrees"),
        ("degree", "-150 10", ""),
        ("radian", "-2.6 2.6", ""),
    ],
)
def test_ranges_of_the_other_unit(angle, limits, said):
    found = bad(check_ranges(balls(angle, limits).physics.model))
    assert bool(found) == bool(said)
    assert not said or re.search(said, found["ranges"])


@pytest.mark.parametrize("turned", [True, False])
def test_a_start_without_a_rotation(turned):
    assert bool(bad(check_placed(balls(turned=turned)))) == (not turned)


# --- networks ---

OBSERVATION = {
    "policy": np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32),
    "privileged": np.random.default_rng(1).normal(size=(8, 2)).astype(np.float32),
}
ONE = {name: jnp.zeros(x.shape[1:]) for name, x in OBSERVATION.items()}


@dataclasses.dataclass(frozen=True)
class Flaw:
    value_reads: tuple = ("policy", "privileged")
    policy_reads: tuple = ("policy",)
    idle: tuple = ()
    nan: bool = False
    zeros: bool = False  # in the last layers: until they are trained, nothing before them is
    mixes: bool = False  # a batch
    root: bool = False  # of a parameter that begins at 0, where its slope is infinite


class Small(nn.Module):
    flaw: Flaw

    @nn.compact
    def __call__(self, observation):
        def read(names):
            parts = [nn.Dense(1)(observation[name]) for name in names]
            kernel = nn.initializers.zeros if self.flaw.zeros else nn.initializers.ones
            return (
                nn.Dense(1, kernel_init=kernel)(sum(parts)) if parts else jnp.full((8, 1), jnp.nan)
            )

        loc, value = read(self.flaw.policy_reads), read(self.flaw.value_reads)[..., 0]
        for name in self.flaw.idle:
            self.param(name, nn.initializers.ones, (2,))
        if self.flaw.root:
            value += jnp.sqrt(jnp.abs(self.param("root", nn.initializers.zeros, ())))
        loc = loc - loc.mean(0) if self.flaw.mixes else loc
        value = jnp.log(-jnp.exp(value)) if self.flaw.nan else value
        scale = jnp.exp(self.param("scale", nn.initializers.zeros, (1,)))
        return PolicyOutput(Normal(loc, jnp.broadcast_to(scale, loc.shape)), value)


@pytest.mark.parametrize(
    ("flaw", "about", "text"),
    [
        (Flaw(), None, ""),
        (Flaw(value_reads=("policy",)), "inputs", "depend on observation['privileged']"),
        (Flaw(policy_reads=("policy", "privileged")), "inputs", "policy reads observation['priv"),
        (Flaw(idle=("a",)), "gradients", "warning: params/a has none: it is never trained"),
        (
            Flaw(idle=("a", "b")),
            "gradients",
            "params/a, params/b have none: they are never trained",
        ),
        (Flaw(nan=True), "outputs", "error: value is not finite"),
        (Flaw(nan=True, policy_reads=()), "outputs", "error: loc, value are not finite"),
        (Flaw(zeros=True), None, ""),
        (Flaw(mixes=True), "batch", "error: alone an observation has another answer"),
        (Flaw(root=True), "gradients", "error: of params/root are not finite"),
    ],
)
def test_a_network(flaw, about, text):
    found = bad(examine_network.examine(from_linen(Small(flaw), ONE), OBSERVATION))
    assert list(found) == ([about] if about else [])
    assert text in found.get(about, "")


def test_our_networks_are_well():
    assert not bad(examine_network.examine(mlp(MlpOptions(), ONE, 2), OBSERVATION))
    lstm = recurrent(RecurrentOptions(cell="lstm", hidden=8), ONE, 2)
    assert not bad(examine_network.examine(lstm, OBSERVATION))


def test_a_memory_that_never_changes():
    init, apply, *_ = recurrent(RecurrentOptions(hidden=8), ONE, 2)

    def forgetful(params, observation, carry):
        return apply(params, observation, carry)[0], carry

    found = bad(examine_network.examine(Network(init, forgetful), OBSERVATION))
    assert "never changes" in found["memory"]


@pytest.mark.parametrize(
    ("minibatches", "seconds", "steps"),
    [(8, 0.01, 20), (8, 1.0, 4), (8, 100.0, 1), (12, 1.0, 3), (12, 0.7, 6), (12, 100.0, 3)],
)
def test_an_update_is_timed_of_no_more_steps_than_time_allows(minibatches, seconds, steps):
    """8 environments; 12 minibatches have whole ones of each three steps."""
    length = 20 if minibatches == 8 else 21
    config = Config(10_000, num_envs=8, rollout_length=length, num_minibatches=minibatches)
    assert examine.timed_steps(config, seconds) == steps


HELD = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><joint name="k" range="-1 1"/>
<geom size=".1" pos=".3 0 0"/></body></worldbody><actuator><position joint="j" kp="20"/></actuator>
</mujoco>"""


@dataclasses.dataclass(frozen=True)
class Held(Toy):
    """A servo that holds its pose; `given` is what init gets more, `late` what step does."""

    physics: Physics
    given: dict
    late: dict
    action_size = 1

    def reset(self, key):
        qpos = 0.9 + 0.01 * jax.random.normal(key, (2,))
        physics, readings = self.physics.init(qpos, jnp.zeros(2), **self.given)
        return toy_state(readings.xpos[1, :2]).replace(physics=physics)

    def step(self, state, action):
        ctrl = 0.9 + 0.1 * action
        physics, readings = self.physics.step(state.physics, ctrl, **self.late)
        return toy_state(readings.xpos[1, :2]).replace(physics=physics)


ROUGH = {"changes": {"geom_friction": np.full((1, 3), 0.7)}}
IDLE = {"changes": {"jnt_range": np.array([[-0.1, 0.1], [-1.0, 1.0]])}}


@pytest.mark.parametrize(
    ("given", "late", "said"),
    [
        ({"ctrl": np.full(1, 0.9)}, {}, {}),
        ({}, {}, {"placing": "ctrl 0 of servo 0, which is at 0.9"}),
        ({"ctrl": np.full(1, 0.9)} | ROUGH, {}, {"changes": "to init and not to step"}),
        ({"ctrl": np.full(1, 0.9)}, ROUGH, {"changes": "to step and not to init"}),
        ({"ctrl": np.full(1, 0.9)} | ROUGH, ROUGH, {}),
        ({"ctrl": np.full(1, 0.9)} | IDLE, IDLE, {"changes": "'jnt_range'] differs .* nothing"}),
    ],
)
def test_what_init_and_step_are_given(given, late, said):
    physics = Physics(mujoco.MjModel.from_xml_string(HELD), ("xpos", "qacc"), 1, "c")
    found = bad(check_placed(Held(physics, given, late)))
    assert set(found) == set(said)
    for about, text in said.items():
        assert re.search(text, found[about])


def test_eyes_that_see_nothing_or_nothing_that_moves_are_told():
    """No training: pictures of 3 environments, 4 steps."""
    random = np.random.default_rng(0)
    still = np.broadcast_to(random.integers(0, 255, (3, 1, 5, 5), np.uint8), (5, 3, 1, 5, 5))
    moving = random.integers(0, 255, (5, 3, 1, 5, 5), np.uint8)
    pictures = np.concatenate([np.full_like(moving, 230), still, moving], axis=2)

    start, states = (SimpleNamespace(observation={"eyes": x}) for x in (pictures[0], pictures[1:]))
    trial = SimpleNamespace(start=start, states=states)
    said = [f"{one.level}: {one.text}" for one in examine_env.check_pictures(trial)]
    assert len(said) == 3
    assert "eye 0 of observation/eyes is the same grey, 0.9, everywhere" in said[0]
    assert "eye 1 of observation/eyes: nothing moves in it" in said[1]
    assert "100% of pixels move" in said[2]
