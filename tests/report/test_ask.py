"""`python -m purerl.ask`: conditions, lesions, and what is written of them."""

import csv
import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from purerl import ask, eyes, load, networks
from purerl.core.env import State
from purerl.core.errors import UserError
from purerl.experiment.options import Lesion
from purerl.report import asking, bootstrap, comparison, episode_arrays, lesions
from tests.quick import jit

FIRST = "policy/Dense_0"
UNITS = {"layer": (FIRST,), "units": "0-15"}


@pytest.fixture(scope="module")
def run():
    """The cart-pole's policy that comes with purerl."""
    return load("cartpole_swingup")


@pytest.fixture(scope="module")
def pole(run):
    """Its objects, with episodes of 120 steps, and its state."""
    config = dataclasses.replace(run.config, episode_length=120)
    return run.restored.setup._replace(config=config), run.state


@pytest.fixture(scope="module")
def intact(pole):
    """Two episodes without a lesion: of a program that knows of none."""
    return episode_arrays.record(*pole, 0, 2)


def recorded(pole, **lesion):
    setup, state, _ = lesions.lesioned(*pole, Lesion(**lesion), 0)
    return episode_arrays.record(setup, state, 0, 2)


# --- lesions ---


def test_a_lesion_of_nothing_changes_no_bit(pole, intact):
    nothing = recorded(pole, **UNITS, share=0.0)
    for name, x in intact.items():
        np.testing.assert_array_equal(nothing[name], x, err_msg=name, strict=True)


def test_it_lasts_from_begin_to_end_and_before_that_no_bit_differs(pole, intact):
    late = recorded(pole, **UNITS, begin=100, end=110)
    for name, x in intact.items():
        if name != "length":
            np.testing.assert_array_equal(late[name][:, :100], x[:, :100], name, strict=True)
    assert (late["action"][:, 100] != intact["action"][:, 100]).all(), "it comes before the action"
    silent = (late[f"network/{FIRST}"] == 0.0).all(axis=0)
    assert silent[100:110, :16].all()
    assert not (silent[:100].any() or silent[110:].any() or silent[:, 16:].any())


def test_a_lesion_of_everything_stops_the_policy(pole, intact):
    stopped = recorded(pole, layer=("head.loc",))
    assert (stopped["action"] == 0.0).all() and (intact["action"] != 0.0).any()


def test_noise_is_drawn_for_each_step_and_episode_and_clamped_is_held():
    step, x, key = jnp.array([3, 3, 4]), jnp.ones((3, 2, 5000)), jax.random.key(1)
    noise = np.asarray(lesions.changed("noise", x, 0.5, key, step)) - 1.0
    np.testing.assert_allclose(noise.std(axis=-1), 0.5, rtol=0.05)
    rows = noise.reshape(6, -1)
    assert abs(np.corrcoef(rows) - np.eye(6)).max() < 0.1
    again = lesions.changed("noise", x, 0.5, key, step.at[0].set(4)) - 1.0
    assert (again[0] != noise[0]).all() and (again[1:] == noise[1:]).all()
    np.testing.assert_array_equal(lesions.changed("clamp", x, -2.0, key, step), -2.0 * x)
    np.testing.assert_array_equal(lesions.changed("silence", x, 0.25, key, step), 0.75 * x)


def acts(network, hit, observation, memory, step=0):
    """What a network with a lesion of all units of `hit` layers answers, and remembers."""
    params, _ = jit(network.init)(jax.random.key(0))
    dose = {"hit": hit, "strength": 1.0, "during": np.array([0, 9]), "key": jax.random.key(0)}
    apply = jit(lesions.lesioned_apply(network, "silence"))
    steps = jnp.full((2, 1), step)
    output, (memory, _) = apply((params, dose), observation, (memory, steps))
    return np.asarray(output.distribution.loc), memory


def test_each_eye_that_shares_an_encoder_is_lesioned_by_itself():
    def seen(left, right):
        pictures = np.zeros((2, 2, 8, 8), np.float32)
        pictures[:, 0, :4], pictures[:, 1, 4:] = left, right
        return {"policy": np.ones((2, 3), np.float32), "eyes": pictures}

    one = jax.tree.map(lambda x: x[0], seen(0, 0))
    encoder = eyes.Encoder(channels=(3,), kernels=(2,), strides=(2,), features=4)
    network = eyes.mlp(eyes.MlpOptions(policy_hidden=(5,), eyes=encoder), one, 2)
    left, right = (f"Convolutions_0/Dense_0{again}" for again in ("", "_again"))
    channels = np.ones(3, bool)
    hit = {left: channels}
    blind = {x: acts(network, hit, seen(*x), ())[0] for x in ((0, 0), (1, 0), (0, 1))}
    np.testing.assert_array_equal(blind[0, 0], blind[1, 0])
    assert (blind[0, 0] != blind[0, 1]).any()
    both = [
        acts(network, {left: channels, right: channels}, seen(*x), ())[0] for x in ((1, 0), (0, 1))
    ]
    np.testing.assert_array_equal(*both)


def test_what_a_cell_remembers_and_what_it_says_are_two_layers():
    options = networks.RecurrentOptions(hidden=3, encoder=(4,), value_hidden=(4,))
    network = networks.recurrent(options, np.zeros(2, np.float32), 1)
    x, memory, unit = np.ones((2, 2), np.float32), np.ones((2, 3), np.float32), np.ones(3, bool)
    whole, kept = acts(network, {}, x, memory)
    forgets = acts(network, {"cell.0": unit}, x, memory)
    np.testing.assert_array_equal(forgets[0], whole)
    assert (forgets[1] == 0.0).all() and (kept != 0.0).all()
    mute = acts(network, {"cell.1": unit}, x, memory)
    assert (mute[0] != whole).all() and (mute[1] == kept).all()
    np.testing.assert_array_equal(acts(network, {"cell.1": unit}, x, memory, step=9)[0], whole)


def test_a_greater_share_has_the_units_of_a_smaller_one():
    def hit(share, units="4-11,2", seed=0):
        lesion = Lesion(layer=("a",), share=share, units=units)
        return set(np.flatnonzero(lesions.choose_units({"a": 16}, lesion, seed)["a"]).tolist())

    some, more, whole = map(hit, (0.3, 0.6, 1.0))
    assert some < more < whole == {2, *range(4, 12)} and len(some) == 3
    assert hit(0.0) == set() and hit(0.6, seed=1) != more and hit(1.0, "all") == set(range(16))


# --- conditions ---


class Loaded:
    """The cart-pole's sizes; clips; a load that is drawn otherwise than was asked for."""

    action_size = 1
    names = ("Light_1", "Heavy_1")

    def __init__(self, drawn):
        self.drawn = drawn

    def reset(self, key):
        load = jnp.asarray(self.drawn) + 0.1 * jax.random.uniform(key)
        return self.state(load, jnp.zeros(5))

    def step(self, state, action):
        return self.state(state.task["of"]["load"], state.observation + 0.1 * action)

    def state(self, load, seen):
        no, metrics = jnp.zeros((), bool), {"weight": load, "clip": seen[0]}  # of any name
        task = {"of": {"load": load}, "clip": (load > self.drawn + 0.05).astype(jnp.int32)}
        return State(seen, seen, 1.0 + seen[0], no, no, metrics, task)


@pytest.mark.parametrize("option", ["load", "weight"])
def test_the_value_that_each_episode_had_is_told_whatever_was_asked_for(pole, option):
    setup, state = pole[0]._replace(env=Loaded(0.5)), pole[1]
    options = SimpleNamespace(episodes=4, outcome="weight", varied=f"env.{option}", seed=0)
    judge = asking.program(setup, state, options)
    found = asking.named(setup.env, jax.device_get(judge(state, jax.random.key(3))))
    had = found[f"env.{option}"]
    assert len(set(had.tolist())) == 4 and (had >= 0.5).all()
    np.testing.assert_allclose(found["weight"], had, rtol=1e-5)
    answers = [({"run": "a", "seed": 1, "value": 0.3, "units": 0}, found)]
    (line,) = asking.notes(answers, options.varied)
    assert line.startswith(f"env.{option}: 0.3 was asked for, and the episodes had 0.5")
    rows = list(csv.DictReader(comparison.episodes_csv(answers).decode().splitlines()))
    assert [float(row[options.varied]) for row in rows] == had.tolist()
    assert {row["value"] for row in rows} == {"0.3"}
    assert [row["clip"] for row in rows] == ["Heavy_1" if x > 0.55 else "Light_1" for x in had]
    assert len({row["clip"] for row in rows}) == 2
    with pytest.raises(UserError, match="no outcome 'task/clip'"):
        asking.program(setup, state, SimpleNamespace(**vars(options) | {"outcome": asking.CLIP}))


def answer(run, value, values, lesion="intact"):
    about = {"run": run, "seed": 1, "value": value, "lesion": lesion, "units": 0, "strength": None}
    return about, {"landed": np.array(values, float), "lost": np.zeros(len(values))}


def test_intervals_are_of_episodes_and_of_the_means_of_runs():
    runs = [answer(f"r{i}", v, [i / 10 + v] * 6) for v in (0.1, 0.2) for i in range(5)]
    rows = asking.summarize(runs, "landed")
    last = [row for row in rows if row["run"] == "5 runs"]
    assert len(rows) == 12 and [row["value"] for row in last] == [0.1, 0.2]
    expected = bootstrap.mean_interval(np.arange(5) / 10 + 0.1)
    np.testing.assert_allclose(last[0]["interval"], expected)
    assert rows[0]["interval"] == (pytest.approx(0.1), pytest.approx(0.1))
    (alone,) = asking.summarize(runs[:1], "landed")
    assert alone["n"] == 6
    four = [row for row in asking.summarize(runs[:4], "landed") if row["run"] == "4 runs"]
    assert four[0]["interval"] is None
    # The same condition twice makes no second run: a lesion of no unit, or a number given twice.
    assert len(asking.summarize([*runs[:1], *runs[:1]], "landed")) == 2


def test_a_share_of_all_is_not_sure():
    """Wilson's interval, of tables of it."""
    all_of_ten = bootstrap.episode_interval(np.ones(10))
    np.testing.assert_allclose(all_of_ten, (0.7225, 1.0), atol=1e-4)
    half = bootstrap.episode_interval(np.repeat([0.0, 1.0], 10))
    np.testing.assert_allclose(half, (0.2993, 0.7007), atol=1e-4)
    other = np.array([0.0, 0.5, 1.0, 2.0, 3.0])
    assert bootstrap.episode_interval(other) == bootstrap.mean_interval(other)
    assert bootstrap.episode_interval(np.ones(4)) is None


def test_what_changed_nothing_is_told():
    same = [answer("a", 1.0, [1, 2]), answer("a", 2.0, [1, 2]), answer("b", 1.0, [1, 2])]
    assert asking.notes(same, "env.x")[0].startswith("1 of 3 conditions have to the bit")
    assert asking.notes([same[0], answer("a", 2.0, [1, 3]), same[2]], "env.x") == []


def test_one_number_is_both_ends_of_a_range_and_a_lesion_comes_after_none():
    run = load("ant_gaps")
    options = ask.AskOptions(vary=("env.gap-length", "0.3", "0.4"), lesion=Lesion(layer=("a",)))
    source = SimpleNamespace(name="ant_gaps", path=run.folder / "experiment.py")
    found = asking.cases(source, run.experiment, options, "ask")
    assert [(value, x.env.gap_length, lesion.share) for value, x, lesion in found] == [
        (value, (value, value), share) for value in (0.3, 0.4) for share in (0.0, 1.0)
    ]
    shares = dataclasses.replace(options, vary=("lesion.share", "0", "0.5", "0.50"))
    found = asking.cases(source, run.experiment, shares, "ask")
    assert [lesion.share for _, _, lesion in found] == [0.0, 0.5]


# --- the command ---


@pytest.mark.slow
def test_its_rows_are_an_evaluations_and_a_lesions(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--lesion.layer", FIRST, "--episodes", "5", "--vary", "lesion.share", "0", "1"]
    assert ask.main(["cartpole_swingup", *words]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-2:] == ["answers.csv", "answers.png"] and len(said) == 6
    rows = list(csv.DictReader(Path("answers.csv").read_text().splitlines()))
    own, other = ([float(row["episode_return"]) for row in rows if row["lesion"] == name]
                  for name in ("intact", f"silence {FIRST}"))  # fmt: skip
    assert own == run.evaluate(5)["metrics"]["episode_return"]["values"], "to the bit"
    assert [row["units"] for row in rows] == ["0"] * 5 + ["64"] * 5 and max(other) < min(own)
    assert np.asarray(Image.open("answers.png")).std() > 5
    assert ask.main(["cartpole_swingup", *words]) == 2, "the file is there"
    assert "answers.csv is there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--vary", "env.substeps"], "vary is env.substeps; give values too"),
        (["--vary", "env.substeps", "x"], "--env.substeps is 'x'; it must be a whole number"),
        (["--lesion.units", "3"], "The lesion has no layer"),
        (["--lesion.layer", FIRST, "--lesion.units", ""], "units is ''; it must be all, or"),
        (["--lesion.layer", FIRST, "--lesion.units", "5-4"], "units is '5-4'; there are 0 to 63"),
        (["--lesion.layer", FIRST, "--lesion.begin", "9", "--lesion.end", "9"], "below end, 9."),
        (["--lesion.layer", FIRST, "--vary", "lesion.share", "2"], "share is 2.0; it must be"),
        (["--lesion.layer", FIRST, "--lesion.strength", "1.5"], "strength is 1.5; it must be"),
        (
            ["--lesion.layer", FIRST, "--lesion.end", "0"],
            "begin is 0; it must be 0 or more, and be",
        ),
        (
            ["--lesion.layer", FIRST, "--lesion.kind", "clamp", "--lesion.strength", "nan"],
            "strength is nan; it must be",
        ),
        (["--out", "/nowhere/a.csv"], "/nowhere/a.csv cannot be written"),
        (["--out", "a.png"], "a.png is the picture's name: give the table's"),
        (["ant_gaps"], "The runs differ in experiment"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    assert ask.main(["cartpole_swingup", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


def test_an_observation_of_another_size_is_refused(run, monkeypatch):
    other = run.restored.setup._replace(env=SimpleNamespace(reset=lambda key: State(
        *[jnp.zeros(3)] * 2, 0.0, False, False, {}, ())))  # fmt: skip
    monkeypatch.setattr(asking, "build", lambda experiment: other)
    with pytest.raises(UserError, match=r"make an observation \[3\], and the policy was .* \[5\]"):
        asking.setup_of(dataclasses.replace(run.experiment, seed=9), run)


def test_a_network_of_no_flax_has_no_layers(pole):
    setup, state = pole
    plain = setup.network._replace(apply=lambda params, seen, memory: (seen, memory))
    assert lesions.units_of(setup._replace(network=plain), state) == {}
