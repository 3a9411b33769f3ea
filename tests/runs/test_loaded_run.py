"""`purerl.load`: a run read back, and its policy in use."""

import dataclasses
import doctest
import json
import pickle
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import purerl
from purerl import evaluate
from purerl.core.keys import Purpose, derive, per_environment
from purerl.experiment import loading
from purerl.report.episode_arrays import record
from purerl.runs import loaded_run, policy
from purerl.training import train
from tests.golden import privileged, recurrent

# All bits that are compared are of one process.
pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

ROOT = Path(__file__).parent.parent.parent
FEW = {"ppo.num_steps": 512, "network.value_hidden": (8,), "evaluation.number": 0}


@pytest.fixture(scope="module", params=[recurrent, privileged], ids=["memory", "dict"])
def run(request, tmp_path_factory) -> purerl.Run:
    place = tmp_path_factory.mktemp(request.param.__name__)
    return purerl.train(request.param.__file__, FEW, runs=place)


def first_keys(seed: int, number: int):
    """Keys of the starts of an evaluation's episodes."""
    key = derive(jax.random.key(seed), Purpose.EVALUATION)
    return per_environment(jax.random.split(key)[0], jnp.arange(number))


def test_its_actions_are_those_of_an_evaluation(run):
    """The episodes are played from Python, an action at a time."""
    judged = run.evaluate(episodes=3, seed=5)["metrics"]
    step, state = jax.jit(jax.vmap(run.env.step)), jax.vmap(run.env.reset)(first_keys(5, 3))
    run.policy.reset()
    returns = np.zeros(3)
    for _ in range(run.config.episode_length):
        observation = jax.tree.map(np.asarray, state.observation)
        action = run.policy(observation)
        assert isinstance(action, np.ndarray) and action.shape == (3, 1)
        state = step(state, jnp.asarray(action))
        returns += np.asarray(state.reward)
    np.testing.assert_allclose(returns, judged["episode_return"]["values"], rtol=1e-5)
    assert np.std(returns) > 1e-3


def test_a_policys_memory_is_what_an_episode_records(run):
    """After t calls it is the memory before step t."""
    recorded = record(run.restored.setup, run.state, 0, 2)
    names = [name for name in recorded if name.startswith("memory")]
    seen = {k.removeprefix("observation/"): x for k, x in recorded.items() if "observation" in k}
    run.policy.reset()
    assert run.policy.memory is None
    for t in range(3):
        now = {k: x[:, t] for k, x in seen.items()}
        run.policy(now.get("observation", now))
        leaves = jax.tree.leaves(run.policy.memory)
        assert len(leaves) == len(names)
        for name, leaf in zip(names, leaves, strict=True):
            assert leaf.shape == recorded[name][:, t + 1].shape
            np.testing.assert_allclose(leaf, recorded[name][:, t + 1], atol=1e-5)


def test_one_observation_or_several_give_the_same(run):
    state = jax.vmap(run.env.reset)(first_keys(0, 6))
    many = jax.tree.map(lambda x: np.asarray(x).reshape(2, 3, *x.shape[1:]), state.observation)
    run.policy.reset()
    first, second = run.policy(many), run.policy(many)
    assert first.shape == (2, 3, 1)
    run.policy.reset()
    one = [run.policy(jax.tree.map(lambda x: x[1, 2], many)) for _ in range(2)]
    assert one[0].shape == (1,)
    np.testing.assert_allclose(one, [first[1, 2], second[1, 2]], rtol=1e-5, atol=1e-7)
    remembers = len(jax.tree.leaves(run.state.memory)) > 0
    assert (np.abs(first - second).max() > 1e-6) == remembers
    if remembers:
        with pytest.raises(purerl.UserError, match=r"remembers environments \[\].*call reset"):
            run.policy(many)
    run.policy.reset()
    np.testing.assert_array_equal(run.policy(many), first)


def test_a_key_samples(run):
    state = run.env.reset(jax.random.key(0))
    run.policy.reset()
    centre = run.policy(state.observation)
    actions = []
    for seed in (1, 1, 2):
        run.policy.reset()
        actions.append(run.policy(state.observation, jax.random.key(seed)))
    assert actions[0] == actions[1] != actions[2] and centre not in actions


def test_a_wrong_observation_is_one_line(run):
    right = jax.eval_shape(run.env.reset, jax.random.key(0)).observation
    wrong = [np.zeros(4), np.zeros(()), {"policy": np.zeros(9)}, [0.0, 1.0], None, "x"]
    if isinstance(right, dict):
        wrong.append({"policy": np.zeros((2, 3)), "velocity": np.zeros((3, 2))})
    for observation in wrong:
        with pytest.raises(purerl.UserError, match="it must be ") as error:
            run.policy(observation)
        assert "\n" not in str(error.value)


def test_it_evaluates_as_the_command_does(run, tmp_path):
    file = tmp_path / "judged.json"
    words = ["--episodes", "4", "--seed", "2", "--stochastic", "--json", str(file)]
    assert evaluate.main([str(run.folder), *words]) == 0
    again = purerl.load(run.folder).evaluate(episodes=4, seed=2, stochastic=True)
    assert json.loads(file.read_text()) == again
    with pytest.raises(purerl.UserError, match="episodes is 0"):
        run.evaluate(0)
    with pytest.raises(purerl.UserError, match="episodes is 2.5; it must be a whole n"):
        run.evaluate(2.5)
    for seed in (-1, 2**32):  # JAX would take the one for another
        with pytest.raises(purerl.UserError, match="seed is"):
            run.evaluate(1, seed=seed)


def test_a_checkpoint_and_an_engine_can_be_chosen(run):
    first = purerl.load(str(run.folder), checkpoint=1)
    assert first.update == 1 < run.update and first.digest != run.digest
    with pytest.raises(purerl.UserError, match="no checkpoint '77'"):
        purerl.load(run.folder, checkpoint="77").state  # noqa: B018
    assert purerl.load(run.folder, engine="c").evaluate(1)["engine"] == "c"


def test_metrics_are_columns_of_one_length(run, tmp_path):
    columns = run.metrics()
    assert columns["update"] == list(range(1, run.update + 1))
    assert {len(column) for column in columns.values()} == {run.update}
    assert None in columns["digest"] or len(columns["digest"]) == run.update
    file = tmp_path / "metrics.jsonl"
    (tmp_path / "config.json").touch()
    file.write_text('{"update": 1, "a": 0.5}\n{"update": 2, "b": null}\n{"update": 3, "a"')
    assert purerl.Run(tmp_path).metrics() == {
        "update": [1, 2], "a": [0.5, None], "b": [None, None]
    }  # fmt: skip


def test_metrics_of_a_run_that_is_gone_are_an_error(tmp_path):
    with pytest.raises(purerl.UserError, match="no folder"):
        purerl.Run(tmp_path / "gone").metrics()


def test_a_run_keeps_its_place_when_the_process_goes_elsewhere(run, tmp_path, monkeypatch):
    monkeypatch.chdir(run.folder.parent)
    found = purerl.load(run.folder.name)
    monkeypatch.chdir(tmp_path)
    assert found.metrics() == run.metrics()


def test_a_policy_is_pickled_with_what_it_remembers(run):
    policy = run.policy
    policy.reset()
    seen = jax.tree.map(lambda x: np.ones((2, *x.shape)), policy._example)
    policy(seen)
    copied = pickle.loads(pickle.dumps(policy))
    assert copied is not policy
    np.testing.assert_array_equal(copied(seen), policy(seen))
    assert pickle.loads(pickle.dumps(run)).digest == run.digest
    by_hand = type(policy)(run.env, run.network, run.state)
    with pytest.raises(purerl.UserError, match="of no run"):
        pickle.dumps(by_hand)


def test_metrics_start_no_jax(run):
    code = (
        "import sys, purerl; found = purerl.load(sys.argv[1]).metrics();"
        "print(len(found['update']), 'jax' in sys.modules)"
    )
    command = [sys.executable, "-c", code, str(run.folder)]
    said = subprocess.check_output(command, text=True, cwd=ROOT)
    assert said.split() == [str(run.update), "False"]


def test_a_folder_without_a_run_is_one_line(run, tmp_path):
    with pytest.raises(purerl.UserError, match="is no run: it has no config.json.$"):
        purerl.load(tmp_path)
    with pytest.raises(purerl.UserError, match="Runs found: "):
        purerl.load(run.folder.parent)


def test_the_examples_in_the_docstrings_hold(tmp_path, capsys):
    names = {"train": train.train, "load": loaded_run.load, "np": np, "place": tmp_path}
    names |= {"find": loading.find, "folder": tmp_path / "cartpole_swingup" / "first"}
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    for thing in (loading.find, train.train, loaded_run.load, policy.Policy):
        (test,) = finder.find(thing, globs=dict(names))
        assert test.examples
        runner.run(test)
    assert runner.failures == 0, capsys.readouterr().out


def test_a_policy_inside_of_jit_says_what_to_do(run):
    state = run.env.reset(jax.random.key(0))
    run.policy.reset()
    with pytest.raises(purerl.UserError, match=r"is traced, by jax.jit.*Compile env.step alone"):
        jax.jit(lambda state: run.env.step(state, run.policy(state.observation)))(state)
    assert run.policy(state.observation).shape == (1,)  # nothing traced has got into its memory


def test_a_policy_needs_no_run(run):
    made = purerl.Policy(run.env, run.network, run.state)
    observation = run.env.reset(jax.random.key(3)).observation
    run.policy.reset()
    np.testing.assert_array_equal(made(observation), run.policy(observation))
    assert dataclasses.is_dataclass(run)
