"""A run with eyes and a memory keeps the promises of one without; the tutorial's own body."""

import shutil

import jax
import numpy as np
import pytest

import purerl
from purerl import __main__ as commands, run
from purerl.core.errors import SUCCESS
from purerl.report.policy_file import record_episodes
from purerl.report.policy_npz import write_npz
from purerl.report.policy_onnx import write_onnx
from tests.docs.blocks import ROOT, blocks

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("file_is_compiled_quickly")]
PAGE = ROOT / "docs" / "tutorials" / "your_eyes.md"
WORDS = """
--ppo.num-steps 256 --ppo.num-envs 8 --ppo.rollout-length 8 --ppo.num-minibatches 2 --checkpoints 4
--ppo.episode-length 10 --evaluation.number 1 --evaluation.num-episodes 4 --env.size 8
--network.hidden 8 --network.encoder 8 --network.value-hidden 8 --network.eyes.features 8
--network.eyes.channels 4 --network.eyes.kernels 4 --network.eyes.strides 4
""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def seeker(tmp_path_factory):
    """The page's experiment with a GRU, trained for four updates: 25 s."""
    folder = tmp_path_factory.mktemp("seeker")
    (page,) = (b.code for b in blocks(PAGE.read_text()) if b.title == "seeker.py")
    page = page.replace("eyes.mlp", "eyes.recurrent").replace("eyes.MlpOpt", "eyes.RecurrentOpt")
    (folder / "seeker.py").write_text(page)
    assert run.main([str(folder / "seeker.py"), "--runs", str(folder), *WORDS]) == SUCCESS
    return folder


def test_a_run_with_eyes_goes_on_to_the_same_digest(seeker):
    whole = purerl.load(seeker / "seeker" / "seed1")
    copy = shutil.copytree(seeker / "seeker", seeker / "again" / "seeker") / "seed1"
    last = sorted((copy / "checkpoints").iterdir())[-1]
    shutil.rmtree(last)
    words = [str(seeker / "seeker.py"), "--runs", str(seeker / "again"), *WORDS, "--resume"]
    assert run.main(words) == SUCCESS
    assert purerl.load(copy).digest == whole.digest
    assert jax.tree.leaves(whole.state.normalizer.mean["eyes"]) == []


def test_seeds_can_be_trained_together(seeker, tmp_path):
    words = [*WORDS, "--num-seeds", "2"]
    assert run.main([str(seeker / "seeker.py"), "--runs", str(tmp_path), *words]) == SUCCESS
    alone, together = (
        purerl.load(place / "seeker" / "seed1").metrics()["train/policy_loss"]
        for place in (seeker, tmp_path)
    )
    np.testing.assert_allclose(alone, together, atol=1e-4)


def test_the_policy_can_be_taken_away_with_its_eyes(seeker, tmp_path):
    trained = purerl.load(seeker / "seeker" / "seed1")
    recorded = record_episodes(trained, seed=1)
    assert recorded.observation["eyes"].dtype == np.uint8
    assert recorded.difference(write_npz(trained, tmp_path / "p.npz")) < 1e-5
    assert recorded.difference(write_onnx(trained, tmp_path / "p.onnx")) < 1e-5
    words = ["export", str(trained.folder), "--format", "jax"]
    assert commands.main([*words, "--out", str(tmp_path / "policy.jax")]) == SUCCESS


def test_what_it_sees_is_in_the_video(seeker, opengl):
    frames, _ = purerl.frames(purerl.load(seeker / "seeker" / "seed1"), seconds=0.2, size=(96, 64))
    corner = frames[0, :32, -32:]
    blocks_of_4 = corner.reshape(8, 4, 8, 4, 3)
    assert (blocks_of_4 == blocks_of_4[:, :1, :, :1]).all() and len(np.unique(corner)) > 2
