"""`python -m purerl.export RUN`: the policy that was taken away is the run's own."""

import functools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import purerl
from purerl import __main__ as commands
from purerl.core.errors import USAGE
from purerl.experiments import custom_network
from purerl.report import episode_arrays, numpy_policy, policy_npz
from purerl.report.policy_file import Recorded, control_range, origin, record_episodes
from tests.golden import privileged, recurrent
from tests.test_readme import PAGES, blocks

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("file_is_compiled_quickly")]

ROOT = Path(__file__).parent.parent.parent
PYTHON = blocks(PAGES["docs/howto/export.md"].read_text(), "python")
NIGHTLY = pytest.mark.nightly
FEW = {"ppo.num_steps": 256, "network.value_hidden": (8,), "evaluation.number": 0}
OWN = {"ppo.num_steps": 512, "ppo.num_envs": 4, "ppo.rollout_length": 16, "ppo.episode_length": 20}
KINDS = {
    "relu": (privileged, {"network.activation": "relu"}),
    "elu": (privileged, {"network.activation": "elu", "network.policy_hidden": (9, 7)}),
    "linear": (privileged, {"network.policy_hidden": ()}),
    "gru": (recurrent, {"network.cell": "gru", "network.activation": "tanh"}),
    "lstm": (recurrent, {}),
    "own": (custom_network, OWN),
}


def shaken(run: purerl.Run) -> purerl.Run:
    """The run with parameters of a size that matters: a young policy's actions are nearly 0."""
    leaves, tree = jax.tree.flatten(run.state.params)
    keys = jax.random.split(jax.random.key(3), len(leaves))
    moved = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    state = run.state.replace(params=jax.tree.unflatten(tree, moved))
    restored = run.restored._replace(saved=run.restored.saved._replace(state=state))
    other = purerl.load(run.folder)
    other.__dict__["restored"] = restored  # the cached property
    return other


@functools.cache
def trained(kind: str, place: Path) -> tuple[purerl.Run, Recorded]:
    module, settings = KINDS[kind]
    run = shaken(
        purerl.train(
            module.__file__, (settings if kind == "own" else FEW | settings), name=kind, runs=place
        )
    )
    recorded = record_episodes(run, seed=1)
    assert np.std(recorded.action) > 0.1
    return run, recorded


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.mark.parametrize(
    "kind", ["relu", "elu", "lstm", *(pytest.param(n, marks=NIGHTLY) for n in ("linear", "gru"))]
)
def test_npz_and_its_reader_act_as_the_run_does(kind, place, tmp_path):
    run, recorded = trained(kind, place)
    assert recorded.length.sum() == 160
    assert recorded.difference(policy_npz.write_npz(run, tmp_path / "p.npz")) < 2e-6
    policy = numpy_policy.Policy(tmp_path / "p.npz")
    state = run.env.reset(jax.random.key(0))
    seen = state.observation["policy"] if isinstance(state.observation, dict) else state.observation
    first = policy.control(seen)
    np.testing.assert_allclose(
        first,
        purerl.lookup.scale_action(
            run.env.physics.model, jnp.asarray(run.policy(state.observation))
        ),
        atol=1e-5,
    )
    second = policy.control(seen)
    policy.reset()
    np.testing.assert_array_equal(policy.control(seen), first)
    assert (np.abs(second - first).max() > 1e-4) == (kind in ("gru", "lstm"))
    arrays = np.load(tmp_path / "p.npz")
    assert (str(arrays["experiment"]), str(arrays["digest"])) == (
        run.folder.parent.name,
        run.digest,
    )
    assert arrays["control_timestep"] == run.env.control_timestep


def test_a_difference_is_found_wherever_it_is():
    """Whatever comes after an episode's end is none; NaN is the largest there is."""
    action = np.zeros((2, 3, 1), np.float32)
    recorded = Recorded({"policy": action.copy()}, action, np.array([3, 1]))
    calls = iter(range(3))

    def policy(observation):
        assert observation["policy"].shape == (2, 1)
        return np.array([[0.0], [0.5]]) if next(calls) else np.array([[0.0], [0.25]])

    assert recorded.difference(policy) == 0.25
    assert recorded.difference(lambda _: np.full((2, 1), np.nan)) == np.inf


def test_no_controls_are_made_up(place):
    run, _ = trained("lstm", place)
    np.testing.assert_array_equal(control_range(run), run.env.physics.model.actuator_ctrlrange)
    for env in (object(), KINDS):
        other = purerl.load(run.folder)
        other.__dict__["restored"] = run.restored._replace(
            setup=run.restored.setup._replace(env=env)
        )
        assert control_range(other) is None


def test_the_command_writes_it(place, tmp_path, capsys, monkeypatch):
    run, _ = trained("lstm", place)
    monkeypatch.chdir(tmp_path)
    assert commands.main(["export", str(run.folder)]) == 0
    said = capsys.readouterr().out
    assert "actions: " in said and ", over 160 observations of 8 episodes" in said
    assert re.search(r"\npolicy.npz \([\d,]+ bytes\)\n$", said)


def test_a_run_that_was_moved_keeps_the_name_of_its_experiment(place, tmp_path):
    run, _ = trained("relu", place)
    moved = Path(shutil.copytree(run.folder, tmp_path / "moved"))
    assert origin(purerl.load(moved))["experiment"] == origin(run)["experiment"] != tmp_path.name


def test_mistakes_are_one_line(place, tmp_path, capsys):
    run, _ = trained("relu", place)
    with pytest.raises(purerl.UserError, match="network is one of your own: use --format jax"):
        policy_npz.write_npz(trained("own", place)[0], tmp_path / "p.npz")
    assert not (tmp_path / "p.npz").exists()
    for out in (tmp_path / "no" / "p.npz", tmp_path, Path("/dev/full")):
        assert commands.main(["export", str(run.folder), "--out", str(out)]) == USAGE
        said = capsys.readouterr().err
        assert "cannot be written" in said and said.count("\n") == 1


# --- jax ---


def without_purerl(code: str, place: Path) -> str:
    """Runs code in a folder, in a process of its own that has not imported purerl."""
    check = "\nimport sys\nassert not [name for name in sys.modules if 'purerl' in name]\n"
    command = [sys.executable, "-c", code + check]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("kind", ["relu", "lstm", "own"])
def test_jax_reads_the_program_in_a_process_without_purerl(kind, place, tmp_path):
    pytest.importorskip("flatbuffers")
    from purerl.report import policy_jax

    run, recorded = trained(kind, place)
    assert recorded.difference(policy_jax.write_jax(run, tmp_path / "policy.jax")) < 2e-6
    assert not re.findall(rb"/[\w./-]+\.py", (tmp_path / "policy.jax").read_bytes())
    seen = recorded.observation
    np.savez(tmp_path / "seen.npz", **(seen if isinstance(seen, dict) else {"": seen}))
    (block,) = [block for block in PYTHON if "deserialize" in block]
    said = without_purerl(block + EPISODES, tmp_path)
    # What only the value function reads is not asked for.
    assert said == ("['policy']\n" if kind == "relu" else "array\n")
    actions = np.load(tmp_path / "actions.npy")
    np.testing.assert_allclose(actions.swapaxes(0, 1), recorded.action, atol=2e-6)


EPISODES = """
seen, actions = dict(np.load("seen.npz")), []
memory = jax.tree.map(lambda x: np.zeros((8, *x.shape[1:]), x.dtype), memory)
for t in range(20):
    now = {name: x[:, t] for name, x in seen.items()}
    now = {name: now[name] for name in observation} if isinstance(observation, dict) else now[""]
    action, memory = program.call(now, memory)
    actions.append(action)
np.save("actions.npy", actions)
print(sorted(observation) if isinstance(observation, dict) else "array")
"""


# --- the page ---

READER = Path(str(numpy_policy.__file__)).read_text()
(DRIVE,) = (block for block in PYTHON if "def episode(" in block)


def test_the_reader_is_short_and_needs_numpy_alone():
    assert re.findall(r"^(?:import|from) (.*)$", READER, re.MULTILINE) == ["numpy as np"]
    code = [line for line in READER.splitlines() if line and not line.strip().startswith('"""')]
    assert len(code) <= 55


@pytest.mark.slow
def test_plain_mujoco_with_an_exported_policy_has_the_returns_of_the_run(place, tmp_path):
    """In a process that has neither purerl nor JAX, from the starts of an evaluation."""
    file, runs = "experiments/cartpole_swingup.py", place / "plain"
    settings = {"ppo.num_steps": 8192, "ppo.episode_length": 60, "evaluation.number": 0}
    run = shaken(purerl.train(file, settings, runs=runs))
    arrays = episode_arrays.record(run.restored.setup, run.state, 0, 5)
    policy_npz.write_npz(run, tmp_path / "policy.npz")
    starts = np.stack([arrays["physics/qpos"][:, 0], arrays["physics/qvel"][:, 0]], axis=1)
    np.save(tmp_path / "starts.npy", starts)
    (tmp_path / "numpy_policy.py").write_text(READER)
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    definitions, main = DRIVE.split("rng = ")
    assert "episode(rng)" in main
    (tmp_path / "drive.py").write_text(definitions + REPLAY)
    done = subprocess.run(
        [sys.executable, "drive.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    *returns, foreign = done.stdout.split()
    assert foreign == "[]"
    mine = np.array(returns, float)
    assert np.std(mine) > 1e-3
    np.testing.assert_allclose(mine, arrays["reward"].sum(axis=1), rtol=1e-4)


REPLAY = """
import sys
for start in np.load("starts.npy"):
    class Start:
        def uniform(low, high, shape):
            return start
    print(episode(Start, 60))
print([name for name in ("jax", "purerl") if name in sys.modules])
"""
