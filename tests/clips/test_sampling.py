"""Sets of clips, and which clip is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import UserError, clips
from purerl.clips.records import behaviour_of
from purerl.clips.sampling import MANY

NAMES = tuple(f"{kind}_{i}.p" for kind in ("Walk", "Rear", "Groom") for i in range(20))


def some(names=NAMES, rate=50.0) -> clips.Clips:
    """Returns clips whose qpos counts frames, and whose number is in qvel."""
    number = len(names)
    qpos = jnp.tile(jnp.arange(30.0)[None, :, None], (number, 1, 2))
    qvel = jnp.tile(jnp.arange(float(number))[:, None, None], (1, 30, 2))
    lengths = jnp.arange(number, dtype=jnp.int32) % 20 + 11
    return clips.Clips(qpos, qvel, lengths, tuple(names), rate)


@pytest.mark.parametrize(
    ("name", "behaviour"),
    [("FastWalk_12.p", "FastWalk"), ("clip_0003", "clip"), ("s/rear/07", "s/rear"), ("12", "12")],
)
def test_a_behaviour_is_the_name_without_its_number(name, behaviour):
    assert behaviour_of(name) == behaviour


def test_clips_are_chosen_by_behaviour_or_name():
    found = clips.choose(some(), "Rear", "Walk_3.p")
    assert found.names == ("Walk_3.p", *NAMES[20:40])
    assert np.asarray(found.qvel[:, 0, 0]).tolist() == [3, *range(20, 40)]
    with pytest.raises(UserError, match="no clip or behaviour 'Raer'. Did you mean 'Rear'"):
        clips.choose(some(), "Raer")


def test_a_clip_is_on_one_side_whatever_else_there_is():
    train, out = clips.split(some(), 0.2, seed=1)
    assert not set(train.names) & set(out.names) and len(train.names) + len(out.names) == 60
    assert 4 <= len(out.names) <= 20
    again, more = clips.split(some((*NAMES[::-1], "Jump_1", "Jump_2")), 0.2, seed=1)
    assert set(out.names) <= set(more.names) and set(train.names) <= set(again.names)
    assert set(clips.split(some(), 0.2, seed=2)[1].names) != set(out.names)
    # The same in every process and for ever: no hash of Python's.
    assert clips.split(some(NAMES[:20]), 0.2)[1].names == ("Walk_0.p", "Walk_16.p")
    with pytest.raises(UserError, match="0 of 60 clips are held out, and neither side"):
        clips.split(some(), 1e-9)
    for share in (30, 0.0, 1.0, float("nan")):
        with pytest.raises(UserError, match=f"held_out is {share}; it must be a share"):
            clips.split(some(), share)


def test_a_part_is_cut_with_both_its_ends():
    part = clips.cut(some(), "Walk_19.p", 0.1, 0.3)
    assert np.asarray(part.qpos[0, :, 0]).tolist() == list(range(5, 16))
    assert part.names == ("Walk_19.p",) and part.lengths.tolist() == [11]
    assert np.asarray(part.qvel == 19).all()
    assert clips.cut(some(), "Walk_3.p").qpos.shape == (1, 14, 2)
    with pytest.raises(UserError, match="'Walk_3.p' lasts from 0 to 0.26 s: 0.1 to 0.3 s is no"):
        clips.cut(some(), "Walk_3.p", 0.1, 0.3)
    with pytest.raises(UserError, match="There is no clip 'Walk'"):
        clips.cut(some(), "Walk", 0.1, 0.3)


def test_clips_shorter_than_the_window_are_named():
    clips.check_window(some(), 11)
    with pytest.raises(
        UserError, match=r"3 of 60 clips have fewer than .* 12 frames .* Walk_0.p .11"
    ):
        clips.check_window(some(), 12)


def draws(weights, lengths, window, number=4000):
    keys = jax.random.split(jax.random.key(3), number)
    found = jax.jit(jax.vmap(lambda key: clips.draw(key, weights, lengths, window)))(keys)
    return tuple(np.asarray(x) for x in found)


def test_clips_are_drawn_by_their_weights_and_frames_with_a_whole_window():
    weights, lengths = jnp.array([0.0, 1.0, 3.0, 0.0]), jnp.array([9, 5, 8, 9])
    clip, frame = draws(weights, lengths, 5)
    counts = np.bincount(clip, minlength=4)
    assert counts[0] == counts[3] == 0
    assert abs(counts[2] / 4000 - 0.75) < 0.03
    assert (frame[clip == 1] == 0).all()  # as long as the window
    of_two = np.bincount(frame[clip == 2])
    assert len(of_two) == 4 and of_two.min() > 0.2 * of_two.sum()
    # In proportion: what is twice as large everywhere draws the same.
    assert (draws(2 * weights, lengths, 5)[0] == clip).all()


def test_a_weight_that_is_none_draws_no_clip_that_is_not_there():
    lengths = jnp.array([9, 5, 8])
    assert set(draws(jnp.array([1.0, jnp.nan, 1.0]), lengths, 5)[0]) == {0, 2}
    assert set(draws(jnp.zeros(3), lengths, 5)[0]) == {0, 1, 2}


def test_no_number_draws_a_clip_of_weight_zero(monkeypatch):
    weights, lengths = jnp.array([0.0, 1.0, 3.0, 0.0]), jnp.array([9, 5, 8, 9])
    for clip, number in ((1, lambda key, shape, low, high: low), (2, lambda *of: of[-1] - 1)):
        monkeypatch.setattr(jax.random, "randint", number)
        assert clips.draw(jax.random.key(0), weights, lengths, 5)[0] == clip


def test_no_clip_of_many_is_left_out_and_no_sum_overflows():
    weights = jnp.ones(5000).at[0].set(1e-7)
    clip, _ = draws(weights, jnp.full(5000, 9), 5, 20000)
    assert clip.min() >= 0 and clip.max() < 5000 and len(np.unique(clip)) > 4500
    assert (clip > 2500).mean() == pytest.approx(0.5, abs=0.02)


def test_weights_move_to_what_fails_and_the_order_of_attempts_is_nothing():
    tally, key = clips.even_tally(4), jax.random.key(0)
    clip = jax.random.randint(key, (300,), 0, 3)
    failed = clip == 1
    one = clips.count(tally, clip, failed)
    assert one.tried.dtype == jnp.int32 and one.tried.tolist()[3] == 0
    assert one.failed.tolist() == [0, int((clip == 1).sum()), 0, 0]
    other = clips.count(tally, clip[::-1], failed[::-1])
    assert all((np.asarray(a) == np.asarray(b)).all() for a, b in zip(one, other, strict=True))
    weights = clips.failure_weights(one)
    assert weights[1] > 0.95 and weights[3] == 0.5
    assert weights[0] == weights[2] == np.float32(0.1)


def test_what_is_long_past_fades():
    tally = clips.even_tally(1)
    for failed in (True, False):
        for _ in range(4):
            tally = clips.count(tally, jnp.zeros(MANY, int), jnp.full(MANY, failed))
    assert tally.tried[0] < 2 * MANY
    assert clips.failure_weights(tally)[0] < 0.15
