"""The window's session: pure, so a program of plain Python stands for the compiled one."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from purerl.report.episode_pictures import Picture
from purerl.tune.view import loop, readouts, session as s
from purerl.tune.view.program import Program, Shown

TIMESTEP = 0.02
MODEL = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint type="slide"/><geom size="1"/></body></worldbody></mujoco>'
)
WEIGHT, WIDTH = ("weight",), ("width",)


class Physics(SimpleNamespace):
    def replace(self, **values):
        return type(self)(**(vars(self) | values))


def picture(x: float) -> Picture:
    return Picture(np.array([x]), np.zeros((0, 3)), np.zeros((0, 4)), {}, ())


def program(ends_after: int = 1000, width: float = 0.5, lost: bool = False) -> Program:
    """Counts steps; the reward is `weight` times the brain."""

    def start(numbers, key) -> Any:
        physics = Physics(qpos=np.zeros(1), qvel=np.zeros(1))
        return Physics(env=Physics(physics=physics), step=0, numbers=dict(numbers)), picture(0.0)

    def step(numbers, brain, moment) -> Any:
        after = moment.replace(step=moment.step + 1)
        reward = numbers[WEIGHT] * brain
        over = after.step >= ends_after
        metrics = {"reward_run": 2 * reward, "reward_cost": -reward, "speed": 7.0}
        action = np.array([0.5, -0.5])
        return after, Shown(
            picture(float(after.step)), reward, metrics, action, 3.0, over and not lost, False,
            over and lost,
        )  # fmt: skip

    env = SimpleNamespace(
        control_timestep=TIMESTEP, action_size=2, physics=SimpleNamespace(model=MODEL)
    )
    return Program(env, {WEIGHT: 2.0}, {WIDTH: width}, start, step)


def opened(*arguments, limit: int = 1000, **more) -> s.Session:
    return s.open_session(program(*arguments, **more), 1.0, "first", limit, seed=3)


# --- time ---


def test_steps_are_taken_as_time_passes():
    session = opened()
    for _ in range(10):
        session = s.advance(session, [(s.tick, 0.03)])
    assert session.length == 15 and session.picture.qpos[0] == 15
    assert s.advance(session._replace(speed=0.5), [(s.tick, 0.04)]).length == 16
    assert s.advance(session, [(s.change, "speed", 2.0), (s.tick, 0.04)]).length == 19


def test_a_slow_computer_owes_no_more_than_a_moment():
    assert s.advance(opened(), [(s.tick, 60.0)]).length == round(s.MOST_OWED / TIMESTEP)


def test_pause_step_and_play():
    session = s.advance(opened(), [(s.play, False), (s.tick, 0.1)])
    assert session.length == 0
    session = s.advance(session, [(s.step,), (s.tick, 0.1)])
    assert session.length == 1 and not session.playing
    assert s.advance(session, [(s.play, True), (s.tick, 0.02)]).length == 2
    assert s.advance(opened(), [(s.tick, 0.05), (s.step,)]).playing is False


# --- episodes ---


def test_an_episode_ends_and_the_next_begins():
    session = s.advance(opened(3), [(s.tick, 0.1)])
    assert session.episode == 1 and session.length == 2 and session.playing
    assert session.ended == "Episode 0 ended after 0.06 s (terminated), return 6."
    assert "time limit" in s.advance(opened(limit=4), [(s.tick, 0.1)]).ended


def test_a_lost_step_is_neither_drawn_nor_counted():
    session = s.advance(opened(3, lost=True), [(s.tick, 0.06)])
    assert "NaN or absurd" in session.ended and "return 4." in session.ended


def test_an_environment_that_ends_at_once_stops_the_window():
    session = s.advance(opened(1), [(s.tick, 0.1), (s.tick, 0.1)])
    assert session.episode == s.INSTANT and not session.playing
    assert "ends at its first step (terminated)" in session.trouble
    assert session.trouble.count("\n") == 0
    again = s.advance(session, [(s.play, True), (s.tick, 0.1)])
    assert again.episode == 2 * s.INSTANT and not again.playing  # tried anew, told anew


def test_next_and_seed_start_other_episodes(monkeypatch):
    keys = []
    monkeypatch.setattr(s, "episode_key", lambda seed, episode: keys.append((seed, episode)))
    session = s.advance(opened(), [(s.tick, 0.1), (s.next_episode,), (s.tick, 0.1), (s.seed, 9)])
    assert keys == [(3, 0), (3, 1), (9, 0)]
    assert session.length == 0 and session.rows == () and session.sums == {}


# --- numbers, programs, checkpoints ---


def test_a_live_number_acts_in_the_next_step():
    session = s.advance(opened(), [(s.step,), (s.slide, WEIGHT, 5.0), (s.step,)])
    assert [row.reward for row in session.rows] == [2.0, 5.0]
    assert s.to_build(session) is None


def test_another_number_waits_for_its_program():
    session = s.advance(opened(), [(s.tick, 0.1), (s.slide, WIDTH, 0.7)])
    assert s.to_build(session) == {WEIGHT: 2.0, WIDTH: 0.7}
    assert s.advance(session, [(s.step,)]).length == 6  # the old one plays on
    session = s.advance(session, [(s.take_program, program(width=0.7))])
    assert s.to_build(session) is None and session.length == 0 and session.episode == 0


def test_what_cannot_be_built_is_told_and_taken_back():
    session = s.advance(
        opened(), [(s.slide, WEIGHT, 9.0), (s.slide, WIDTH, 7.0), (s.fail, "too wide")]
    )
    assert session.trouble == "too wide" and s.to_build(session) is None
    assert session.numbers == {WEIGHT: 9.0, WIDTH: 0.5}
    assert s.advance(session, [(s.slide, WEIGHT, 1.0)]).trouble == ""


def test_another_checkpoint_goes_on_with_the_episode():
    session = s.advance(opened(), [(s.tick, 0.1), (s.change, "chosen", "7")])
    assert session.chosen == "7"
    session = s.advance(session, [(s.take_brain, 10.0, "of update 7"), (s.step,)])
    assert session.rows[-1].reward == 20.0 and session.length == 6 and session.chosen == ""
    failed = s.advance(session, [(s.change, "chosen", "8"), (s.fail, "The checkpoint is damaged.")])
    assert failed.chosen == "" and failed.brain == 10.0 and "damaged" in failed.trouble


def test_slow_work_is_begun_once_and_told(monkeypatch):
    def broken(name):
        raise OSError("the disk is away")

    source: Any = SimpleNamespace(
        program=lambda numbers: program(width=numbers[WIDTH]), brain=broken
    )
    beside = loop.Beside()
    session = s.advance(opened(), [(s.change, "chosen", "best"), (s.slide, WIDTH, 0.75)])
    loop.begin_work(session, source, beside)
    assert beside.words.startswith("reading checkpoint best")
    beside.work.result(10)
    session = s.advance(session, beside.finished())
    assert session.trouble == "OSError: the disk is away"
    session = s.advance(session, [(s.slide, WIDTH, 0.75)])
    loop.begin_work(session, source, beside)
    assert "width = 0.75" in beside.words
    loop.begin_work(session, source, beside)  # nothing more, while it is at it
    beside.work.result(10)
    assert s.advance(session, beside.finished()).program.fixed == {WIDTH: 0.75}
    assert beside.finished() == [] and beside.words == ""


# --- pushes ---


def test_a_push_and_a_pull_change_the_velocity():
    session = s.advance(opened(), [(s.push, (0.0, 0.0, 1.5))])
    np.testing.assert_allclose(session.moment.env.physics.qvel, [1.5])
    session = s.advance(opened(), [(s.pull, 1, (0, 0, 0), (0, 0, 1)), (s.step,)])
    assert session.moment.env.physics.qvel[0] > 0.5
    held = s.advance(session, [(s.pull, 1, (0, 0, 0), (0, 0, -1))])
    np.testing.assert_allclose(held.grip.target, [0, 0, -1])
    free = s.advance(session, [(s.change, "grip", None)])
    assert free.grip is None
    before = free.moment.env.physics.qvel
    assert s.advance(free, [(s.step,)]).moment.env.physics.qvel is before


def test_what_is_no_event_is_refused():
    with pytest.raises(TypeError, match="str is no event"):
        s.advance(opened(), ["play"])


# --- what is said ---


def test_the_table_says_which_term_pays():
    session = s.advance(opened(), [(s.tick, 0.1)])
    table = readouts.reward_table(session)
    assert ">run</th><td>4.000</td><td>4.000</td><td>20.000</td><td>+67%</td>" in table
    assert ">cost</th><td>-2.000</td><td>-2.000</td><td>-10.000</td><td>-33%</td>" in table
    assert "<i>speed</i></th><td>7.000</td>" in table
    assert readouts.reward_table(opened()) == ""


def test_plots_have_a_line_each_and_few_points():
    session = opened()
    for _ in range(150):
        session = s.advance(session, [(s.tick, 0.1)])
    plot = readouts.plots(session)["Reward per step"]
    assert plot.names == ("reward", "run", "cost") and len(plot.columns) == 4
    assert len(plot.columns[0]) <= readouts.MOST_POINTS
    assert np.ptp(plot.columns[0]) == pytest.approx(s.SECONDS_KEPT, abs=0.1)
    assert readouts.plots(session)["Actions"].names == ("a0", "a1")
    assert len(readouts.plots(opened())["Value"].columns[0]) == 0


def test_the_state_is_told_in_lines():
    session = s.advance(opened(3), [(s.tick, 0.1)])
    shown = readouts.said(session, "1.00 x real time")
    lines = ["first, seed 3, episode 1", "0.04 s, step 2, return 4", "1.00 x real time"]
    assert all(f"<div>{line}</div>" in shown for line in [*lines, session.ended])


def test_what_is_said_is_text_whatever_a_file_has_in_it():
    hostile = "<iframe srcdoc='x'></iframe>**a**"
    session = opened()._replace(checkpoint=hostile, trouble=hostile, ended=hostile)
    for shown in (readouts.said(session, hostile), readouts.as_typed(hostile)):
        assert "<iframe" not in shown and "&lt;iframe srcdoc=" in shown and "**a**" in shown
