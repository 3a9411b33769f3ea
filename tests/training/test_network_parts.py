"""A part of a network that is another run's: frozen or not, in its units, without its folder."""

import json
import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from purerl import run
from purerl.checks import examine_network
from purerl.core.errors import INTERRUPTED, SUCCESS, USAGE, UserError
from purerl.devices.programs import abstract_state
from purerl.experiment import objects
from purerl.experiment.command_line import from_command_line
from purerl.experiment.definition import Part
from purerl.experiment.loading import find_source
from purerl.machine import array_files
from purerl.machine.state_arrays import flatten
from purerl.ppo import running_moments
from purerl.runs import checkpoint_folder, taken_parts
from purerl.runs.loaded_run import load
from tests.experiment.test_resumed_settings import refusal
from tests.runs import coded_experiment

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept")


class SimpleState(struct.PyTreeNode):
    normalizer: object


CODED = coded_experiment.__file__
RATES = ["--parts.decoder.rate", "0"]


def start(runs, *words):
    return run.main([CODED, "--runs", str(runs), "--checkpoints", "4", *words])


def place(runs, name="seed1"):
    return runs / "coded_experiment" / name


def taking(old, reads="policy"):
    return [*RATES, "--parts.decoder.run", str(old), "--parts.decoder.reads", reads]


def saved(folder):
    """Returns the arrays of the newest checkpoint by their paths."""
    path = sorted((folder / "checkpoints").iterdir())[-1]
    meta = checkpoint_folder.load_meta(path)
    like = {k: np.zeros(x["shape"], x["dtype"]) for k, x in meta["leaves"].items()}
    return array_files.read(path / "state", {k: x for k, x in like.items() if x.size})


def told(runs, name="seed1"):
    text = (place(runs, name) / "metrics.jsonl").read_text()
    return [{**json.loads(line), "wall_s": 0} for line in text.splitlines()]


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    runs = tmp_path_factory.mktemp("old")
    assert start(runs) == SUCCESS
    return place(runs)


@pytest.fixture(scope="module")
def whole(old, tmp_path_factory):
    """A run with the old one's decoder, frozen, that nobody disturbed."""
    runs = tmp_path_factory.mktemp("whole")
    assert start(runs, *taking(old)) == SUCCESS
    return runs


def test_a_frozen_part_is_the_other_runs_to_the_bit_and_the_rest_moves(old, whole):
    before, after = saved(old), saved(place(whole))
    decoder = {k for k in after if "/decoder/" in k}
    params = {k for k in after if k.startswith("params/")}
    assert len(decoder & params) == 4
    for name in params:
        assert (before[name] == after[name]).all() == (name in decoder), name
    for name in {k for k in after if k.startswith("optimizer/") and "/params/" in k}:
        assert after[name].any() == (name not in decoder), name
    for name in (k for k in after if k.startswith("normalizer/")):
        assert (before[name] == after[name]).all(), name  # the counts are equal too: as many steps


def test_the_manifest_says_whose_part_it_is(old, whole):
    facts = json.loads((place(whole) / "manifest.json").read_text())["parts"]["decoder"]
    theirs = json.loads((old / "manifest.json").read_text())
    assert facts["run"] == theirs["run_id"] and facts["update"] == 12
    assert len(facts["sha256"]) == 64


def test_losses_and_weights_are_logged_by_name(whole):
    line = told(whole)[-1]
    for name in ("code_kl", "sparsity", "prediction"):
        assert np.isfinite(line[f"train/auxiliary/{name}"])
    assert line["train/auxiliary/prediction_weight"] == 1.0
    weights = [line["train/auxiliary/code_kl_weight"] for line in told(whole)]
    assert weights[0] == 0.0 and weights[3] == pytest.approx(0.1 * 96 / 200)


def test_a_killed_run_goes_on_without_the_other_run(old, whole, tmp_path, stop_after, capsys):
    copy = shutil.copytree(old, tmp_path / "gone")
    stop_after(5)
    assert start(tmp_path, *taking(copy)) == INTERRUPTED
    stop_after(10**9)
    shutil.rmtree(copy)
    assert start(tmp_path, "--resume") == SUCCESS, capsys.readouterr().err
    assert told(tmp_path)[-1]["digest"] == told(whole)[-1]["digest"]
    policy, seen = load(place(tmp_path), trust=True).policy, np.ones((2, 1))
    by_mean, drawn = policy(seen), [policy(seen, jax.random.key(1)) for _ in range(2)]
    assert by_mean[0] == by_mean[1] and drawn[0][0] != drawn[0][1]
    np.testing.assert_array_equal(*drawn)


def test_mapped_seeds_are_single_runs(old, whole, tmp_path):
    assert start(tmp_path, *taking(old), "--num-seeds", "2", "--seeds-by", "map") == SUCCESS
    assert told(tmp_path)[-1]["digest"] == told(whole)[-1]["digest"]


def test_each_vmapped_seed_begins_with_the_part():
    drawn = {"params": {"decoder": np.zeros((2, 3)), "encoder": np.zeros((2, 3))}}
    begun = taken_parts.put_in(drawn, {"params/decoder": np.arange(3.0)})["params"]
    np.testing.assert_array_equal(begun["decoder"], [np.arange(3.0)] * 2)
    assert not begun["encoder"].any()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--parts.decoder.checkpoint", "7"], "There is no checkpoint '7' in "),
        (["--network.decoder", "5"], "leaf params/params/decoder/Dense_0/kernel is ['float32', [8, "
         "1]] in it and ['float32', [5, 1]] in this experiment. A part begins as it is there: "
         "give it, and what it reads, those sizes."),
        (["--parts.encoder.run", "x"], "There is no option --parts.encoder.run. parts names decoder"
         ": name others in the experiment's file."),
        (["--ppo.auxiliary.code-kl", "1", "2"], "--ppo.auxiliary.code-kl is '1', '2'; it must be "
         "FLOAT or FLOAT FLOAT INT."),
        (["--ppo.auxiliary", "0.1"], "no option --ppo.auxiliary. Give its entries by name: "
         "--ppo.auxiliary.code_kl, "),
        (["--ppo.auxiliary.code-kl", "0", "1", "-5"], "ppo.auxiliary.code_kl is (0.0, 1.0, -5): "),
        (["--parts.decoder.run", "nowhere"], "nowhere"),
        (["--parts.decoder.reads", "eyes"], "There is no entry of the observation 'eyes'. There "
         "are: policy."),
    ],
)  # fmt: skip
def test_what_the_other_run_has_not_is_one_line(old, tmp_path, capsys, words, says):
    assert start(tmp_path, *taking(old), *words) == USAGE
    said = capsys.readouterr().err
    assert says in said and len(said.splitlines()) == 1, said
    assert not place(tmp_path).exists()


def test_which_part_has_no_run_is_told():
    with pytest.raises(UserError, match=r"^parts.decoder.run: nowhere is no folder"):
        taken_parts.read_parts({"decoder": Part(run="nowhere", reads=())}, {})


def test_the_parts_that_the_other_run_has_are_named(old):
    abstract = abstract_state(*objects.build(coded_experiment.experiment)[:3])
    with pytest.raises(UserError, match="no part 'muscles' in .* There are: critic, decoder, enc"):
        taken_parts.read_parts({"muscles": Part(run=str(old), reads=())}, abstract)
    with pytest.raises(UserError, match="no part 'muscles' in .*/cartpole_swingup. There are: hea"):
        taken_parts.read_parts({"muscles": Part(run="cartpole_swingup", reads=())}, abstract)


@pytest.mark.parametrize(("given", "is_then"), [("0.2", 0.2), ("0.1 0.2 9", (0.1, 0.2, 9))])
@pytest.mark.parametrize("name", ["code_kl", "sparsity"])
def test_a_weight_is_given_in_either_form_whatever_the_file_has(name, given, is_then):
    words = [f"--ppo.auxiliary.{name.replace('_', '-')}", *given.split(), "--seed", "3"]
    chosen, _ = from_command_line(find_source(CODED), words, "run")
    weights = coded_experiment.experiment.ppo.auxiliary
    assert chosen.ppo.auxiliary == weights | {name: is_then}


def test_a_part_of_another_run_needs_its_units():
    for wrong in ({"run": "runs/a"}, {"reads": ("policy",)}):
        with pytest.raises(ValueError, match="a part of another run needs both"):
            Part(**wrong)
    with pytest.raises(ValueError, match=r"reads is 'policy'; give a tuple .*: \('policy',\)"):
        Part(run="runs/a", reads="policy")


def test_one_entry_has_the_units_of_one_run(old):
    abstract = abstract_state(*objects.build(coded_experiment.experiment)[:3])
    both = {"decoder": Part(run=str(old), reads=("policy",)), "guess": Part(run=str(old), reads=())}
    leaves, facts = taken_parts.read_parts(both, abstract)
    assert facts.keys() == both.keys() and {k.split("/")[0] for k in leaves} == {
        "normalizer",
        "params",
    }
    both["guess"] = Part(run=str(old), checkpoint="9", reads=("policy",))
    with pytest.raises(UserError, match="parts.guess: its normalizer/mean/.* is not that of a"):
        taken_parts.read_parts(both, abstract)


def test_an_arrays_units_are_cut_into_entries():
    """A run that was told all is read by one that has it in parts, and a picture beside."""
    leaves = {f"normalizer/{of}/value": np.arange(5.0) for of in ("mean", "variance")}
    leaves["params/params/head/kernel"] = np.ones((2, 2))
    example = {"a": jnp.zeros(2), "b": jnp.zeros(3), "eyes": jnp.zeros((1, 4, 4), jnp.uint8)}
    abstract = SimpleState(normalizer=running_moments.init(example))
    joined = taken_parts._joined(abstract, ("b", "eyes", "a")).normalizer
    assert joined.mean.value.shape == joined.variance.error.shape == (5,)
    cut = taken_parts._cut(leaves, abstract, ("b", "eyes", "a"))
    for of in ("mean", "variance"):
        np.testing.assert_array_equal(cut[f"normalizer/{of}/b/value"], [0, 1, 2])
        np.testing.assert_array_equal(cut[f"normalizer/{of}/a/value"], [3, 4])
    assert len(cut) == 5 and cut["params/params/head/kernel"].shape == (2, 2)


def test_a_run_that_was_told_in_an_array_lends_its_units_to_a_dict(old):
    abstract = abstract_state(*objects.build(coded_experiment.experiment)[:3])
    mean, variance = abstract.normalizer.mean, abstract.normalizer.variance
    both = abstract.normalizer.replace(
        mean={"more": mean, "policy": mean}, variance={"more": variance, "policy": variance}
    )
    dicts = abstract.replace(normalizer=both)
    leaves, _ = taken_parts.read_parts({"decoder": Part(run=str(old), reads=("policy",))}, dicts)
    taken = {key: x for key, x in leaves.items() if key.startswith("normalizer/")}
    assert len(taken) == 4
    for key, x in taken.items():
        assert (x == saved(old)[key.replace("/policy", "")]).all(), key
    for reads, told in [
        (("policy", "more"), r"policy, more, 2 numbers, .* of 1: .* There are: more \(1\), policy"),
        (
            ("more", "policy"),
            "reads is more, policy: an array begins with what the policy may read",
        ),
    ]:
        with pytest.raises(UserError, match=told):
            taken_parts.read_parts({"decoder": Part(run=str(old), reads=reads)}, dicts)


def test_a_rate_of_its_own_is_of_its_parameters_alone():
    one = objects.build(replace(coded_experiment.experiment, parts={"decoder": Part(rate=0.25)}))
    params = jax.eval_shape(one.network.init, jax.random.key(0))[0]
    scaled = flatten(one.network.scale(jax.tree.map(lambda x: np.ones(x.shape), params)))
    assert len(scaled) == 10
    for name, x in scaled.items():
        assert (x == (0.25 if "/decoder/" in name else 1.0)).all(), name


@pytest.mark.parametrize(
    ("part", "refused"),
    [
        (Part(rate=0.0), ""),
        (Part(run="other", reads=()), "parts.decoder"),
        (Part(run="old", reads=("policy",)), "parts.decoder"),
    ],
)
def test_a_run_that_goes_on_takes_no_other_part(part, refused):
    begun = replace(coded_experiment.experiment, parts={"decoder": Part(run="old", reads=())})
    drawn = replace(begun, parts={})
    assert refusal(drawn, parts={"decoder": part}) == refused
    kept = replace(part, run="old", reads=()) if not refused else part
    assert refusal(begun, parts={"decoder": kept}) == refused


def test_check_does_not_warn_of_what_shall_be_frozen():
    """Nor of parameters that only a loss of the network's own trains."""
    frozen = replace(coded_experiment.experiment, parts={"decoder": Part(rate=0.0)})
    seen = np.random.default_rng(0).normal(size=(8, 1)).astype(np.float32)
    *_, last = examine_network.examine(objects.build(frozen).network, seen)
    assert last.text == "each of 10 parameters has one"
