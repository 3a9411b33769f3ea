"""`python -m purerl.record RUN`: its arrays are the run's policy, step by step."""

import json
import types
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import clips, evaluate, load, record, run
from purerl.core.errors import USAGE
from purerl.ppo import running_moments
from purerl.ppo.networks import GaussianHead, PolicyOptions
from purerl.report import episode_arrays
from purerl.runs import restored_run
from tests.training.test_run import TOY

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

TRAIN = """
import dataclasses
from purerl.experiments.cartpole_swingup import experiment
from purerl.ppo.config import Config
from purerl.ppo.networks import MlpOptions, RecurrentOptions, mlp, recurrent

ppo = Config(
    num_steps=1600, num_envs=4, rollout_length=50, num_minibatches=2, episode_length=30
)
experiment = dataclasses.replace(experiment, ppo=ppo, build_network={build}, network={network})
"""
MLP = "MlpOptions(policy_hidden=(5,), value_hidden=(6,), std='state')"
LSTM = "RecurrentOptions(cell='lstm', hidden=3, encoder=(4,), value_hidden=(4,))"


class Recorded(NamedTuple):
    folder: Path
    arrays: dict[str, np.ndarray]
    state: Any


def train_and_record(place: Path, build: str, network: str) -> Recorded:
    file, out = place / "mine.py", place / "out.npz"
    file.write_text(TRAIN.format(build=build, network=network))
    assert run.main([str(file), "--runs", str(place / "runs")]) == 0
    folder = place / "runs" / "mine" / "seed1"
    words = ["--episodes", "3", "--seed", "5", "--out", str(out)]
    assert record.main([str(folder), *words]) == 0
    return Recorded(
        folder, dict(np.load(out)), restored_run.restore(folder, "latest", print).saved.state
    )


@pytest.fixture(scope="module")
def mlp(tmp_path_factory) -> Recorded:
    return train_and_record(tmp_path_factory.mktemp("mlp"), "mlp", MLP)


@pytest.fixture(scope="module")
def lstm(tmp_path_factory) -> Recorded:
    return train_and_record(tmp_path_factory.mktemp("lstm"), "recurrent", LSTM)


@pytest.mark.slow
def test_its_episodes_begin_as_those_of_an_evaluation(lstm, tmp_path):
    folder, arrays, _ = lstm
    file = tmp_path / "judged.json"
    words = ["--episodes", "3", "--seed", "5", "--json", str(file)]
    assert evaluate.main([str(folder), *words]) == 0
    judged = json.loads(file.read_text())["metrics"]["episode_return"]["values"]
    assert arrays["length"].tolist() == [30, 30, 30]
    assert arrays["reward"].shape == (3, 30) and arrays["action"].shape == (3, 30, 1)
    np.testing.assert_allclose(arrays["reward"].sum(axis=1), judged, rtol=1e-5)


@pytest.mark.slow
def test_a_layer_is_computed_from_the_observation_beside_it(mlp):
    """Recomputed from the checkpoint's weights, from the observation to the action."""
    _, arrays, state = mlp
    weights = jax.tree.map(np.asarray, state.params["params"])
    normalized = np.asarray(running_moments.normalize(state.normalizer, arrays["observation"]))
    layer = normalized @ weights["policy"]["Dense_0"]["kernel"]
    layer = layer + weights["policy"]["Dense_0"]["bias"]
    hidden = layer / (1.0 + np.exp(-layer))  # swish
    loc = hidden @ weights["head"]["loc"]["kernel"] + weights["head"]["loc"]["bias"]
    close = {"rtol": 1e-4, "atol": 1e-5}
    np.testing.assert_allclose(arrays["network/policy/Dense_0"], layer, **close)
    np.testing.assert_allclose(arrays["network/policy"], hidden, **close)
    np.testing.assert_allclose(arrays["network/head.loc"], loc, **close)
    np.testing.assert_allclose(arrays["action"], np.tanh(loc), **close)
    np.testing.assert_allclose(arrays["network/value_out"][..., 0], arrays["value"], rtol=1e-6)
    # The head's scale and its layer of that name are two things.
    assert (arrays["network/head.scale"] > 0.0).all()
    assert not np.array_equal(arrays["network/head.scale"], arrays["network/head/scale"])


def test_state_and_observation_are_of_one_moment(mlp):
    arrays = mlp.arrays
    position, angle = np.moveaxis(arrays["physics/qpos"], -1, 0)
    cart, cosine, sine, *_ = np.moveaxis(arrays["observation"], -1, 0)
    np.testing.assert_allclose(np.stack([position, np.cos(angle), np.sin(angle)]),
                               np.stack([cart, cosine, sine]), atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(np.diff(arrays["physics/time"]), 0.02, rtol=1e-4)
    assert not any(array.size == 0 for array in arrays.values())


def test_a_memory_is_what_the_step_before_left(lstm):
    arrays = lstm.arrays
    for i in (0, 1):
        memory = arrays[f"memory/{i}"]
        assert (memory[:, 0] == 0.0).all() and (memory[:, 1] != 0.0).all()
        left = arrays[f"network/cell.0.{i}"][:, :-1]
        # XLA computes it once to be noted and once to be kept, and may round each otherwise.
        np.testing.assert_allclose(memory[:, 1:], left, rtol=1e-6, atol=1e-7)


def test_one_run_is_recorded_at_a_time(monkeypatch, capsys):
    found = None, {"a": None, "b": None}, []
    monkeypatch.setattr(record.subject, "find_runs", lambda words, prog: found)
    assert record.main(["a", "b"]) == USAGE
    assert "2 runs are given; record one at a time." in capsys.readouterr().err


def test_hdf5_has_each_array_where_it_is_looked_for_and_names_its_axes(mlp, tmp_path):
    h5py = pytest.importorskip("h5py", reason="pip install -e '.[clips]'")
    file, arrays = tmp_path / "out.h5", mlp.arrays | {"length": np.array([30, 7, 0])}
    arrays["task/clip"] = np.array([[1], [0], [1]]).repeat(30, axis=1)  # as in imitation
    env = load(mlp.folder).env
    named = types.SimpleNamespace(
        physics=env.physics, control_timestep=env.control_timestep, names=("Rear_1", "Run_2")
    )
    record.write(record.RecordOptions(out=file), arrays, named, {"run": "mine"})
    with h5py.File(file) as found:
        assert found["metadata"].attrs["run"] == "mine"
        steps = found["episodes/1/timesteps"]
        assert dict(steps.parent.attrs)["n_steps"] == 7
        assert [found[f"episodes/{i}"].attrs["clip"] for i in range(3)] == [
            "Run_2",
            "Rear_1",
            "Run_2",
        ]
        places = {"physics/qpos": "qpos", "action": "action", "metrics/upright": "metrics/upright"}
        places |= {"observation": "observations/policy", "physics/time": "time"}
        places |= {f"network/policy{x}": f"activations/policy{x or '/__call__'}"
                   for x in ("", "/Dense_0")}  # fmt: skip
        for name, at in places.items():
            np.testing.assert_array_equal(steps[at], arrays[name][1, :7])
        assert steps["done"][:].tolist() == [0] * 6 + [1]
        named = [steps[name].dims[1][0].asstr()[:].tolist() for name in ("qpos", "action")]
        assert named == [["slide", "hinge"], ["push"]]
        arrays_of_steps = []
        steps.visititems(lambda n, x: arrays_of_steps.append(x) if hasattr(x, "dims") else None)
        for x in arrays_of_steps:
            if x.name.endswith("/time"):
                assert x.is_scale and x.attrs["units"] == "s"
            else:
                assert x.dims[0][0] == steps["time"]
                assert [len(dim[0]) for dim in x.dims] == list(x.shape), x.name
        model, data = env.physics.model, mujoco.MjData(env.physics.model)
        data.qpos[:] = arrays["physics/qpos"][1, 5]
        mujoco.mj_kinematics(model, data)
        pole, turned = (steps[f"world/pole_{name}"][5] for name in ("xpos", "xmat"))
        np.testing.assert_allclose(pole, data.body("pole").xpos, atol=1e-6)
        np.testing.assert_allclose(turned, data.body("pole").xmat.reshape(3, 3), atol=1e-6)
        assert found["episodes/2/timesteps/qpos"].shape == (0, 2)


@pytest.mark.parametrize("ending", ["h5", "hdf5"])
def test_hdf5_opens_in_xarray(mlp, tmp_path, ending):
    import xarray

    file = tmp_path / f"out.{ending}"
    record.write(record.RecordOptions(out=file), mlp.arrays, load(mlp.folder).env, {})
    with xarray.open_datatree(file, engine="h5netcdf") as tree:
        steps = tree["episodes/0/timesteps"]
        assert steps["qpos"].dims == ("time", "qpos_layout")
        hinge = steps["qpos"].sel(qpos_layout="hinge")
        np.testing.assert_array_equal(hinge, mlp.arrays["physics/qpos"][0, :, 1])


def test_episodes_as_clips(mlp, tmp_path):
    pytest.importorskip("h5py", reason="pip install -e '.[clips]'")
    file, arrays = tmp_path / "out.h5", mlp.arrays | {"length": np.array([30, 7, 9])}
    record.write(record.RecordOptions(out=file, clips=True), arrays, load(mlp.folder).env, {})
    motion = clips.read(file)
    assert motion.lengths.tolist() == [30, 7, 9] and motion.rate == pytest.approx(50.0)
    np.testing.assert_array_equal(motion.values[1, :7], arrays["physics/qpos"][1, :7])


@pytest.mark.parametrize(("steps", "length", "ends"), [(4, 4, True), (12, 10, False)])
def test_an_end_before_the_time_limit_is_told_from_the_limit(tmp_path, steps, length, ends):
    runs, out = tmp_path / "runs", tmp_path / "out.npz"
    words = ["--env.steps", str(steps), "--runs", str(runs), "--evaluation.number", "0"]
    assert run.main([str(TOY), *words]) == 0
    folder = runs / "toy_experiment" / "seed1"
    assert record.main([str(folder), "--episodes", "2", "--out", str(out)]) == 0
    arrays = np.load(out)
    assert arrays["length"].tolist() == [length] * 2
    assert arrays["terminated"].tolist() == [[False] * (length - 1) + [ends]] * 2


def test_a_module_that_is_applied_twice_is_noted_twice():
    class Twice(nn.Module):
        @nn.compact
        def __call__(self, x):
            both = GaussianHead(PolicyOptions(initial_std=0.5), 2)
            return both(x), both(x + 1.0)

    module, x = Twice(), jnp.ones(3)
    params, noted = module.init(jax.random.key(0), x), {}
    with nn.intercept_methods(episode_arrays.note_modules(noted)):
        first, second = module.apply(params, x)
    head = "GaussianHead_0"
    np.testing.assert_array_equal(noted[f"{head}.loc"], first.loc)
    np.testing.assert_array_equal(noted[f"{head}.loc_again"], second.loc)
    np.testing.assert_array_equal(noted[f"{head}/loc_again"], second.loc)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--out", "/nowhere/x.npz"], "/nowhere/x.npz cannot be written"),
        (["--out", "/tmp"], "/tmp cannot be written"),
        (["--out", __file__], "is there: name another file, or take that one away"),
        (["--out", "/dev/full", "--episodes", "1"], "/dev/full cannot be written: No space left"),
        (["--clips"], "out is episodes.npz; a file of clips ends in .h5 or .hdf5."),
        (["--env.reset-nois", "1"], "All options: python -m purerl.record /"),
        (["--lesion.kind", "noise"], "The lesion has no layer: add --lesion.layer"),
        (["--checkpoint", "77"], "There is no checkpoint '77'"),
    ],
)
def test_a_mistake_is_one_line(mlp, capsys, words, message):
    assert record.main([str(mlp.folder), *words]) == USAGE
    said = capsys.readouterr().err
    assert message in said and len(said.splitlines()) == 1
