"""The window on a run, in a headless Chromium: its policy, its sliders, its pushes."""

import contextlib
import dataclasses
import functools
import importlib.util
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from purerl import UserError, load, run as train, view
from purerl.core.errors import USAGE
from purerl.tune import subject
from purerl.tune.option_numbers import replaced
from purerl.tune.plan import planner
from purerl.tune.view import opening
from purerl.tune.view.drivers import policy_driver
from purerl.tune.view.program import build_program, episode_key
from purerl.tune.view.session import advance, open_session, push, step, take_step
from tests.report import chromium
from tests.tune.view import sled_experiment as sled

ROOT = Path(__file__).parent.parent.parent.parent
# A browser without a GPU draws by a program of its own.
GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="pip install -e '.[view]'"
)
needs_chromium = pytest.mark.skipif(
    chromium.find() is None, reason="no Chromium here: apt-get install chromium"
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("view")
    words = [sled.__file__, "--runs", str(place), "--name", "one", "--checkpoints", "3"]
    assert train.main(words) == 0
    return place / "sled_experiment" / "one"


def open_with(options, name: Path, *words: str):
    found = subject.find([str(name)], view.PROG)
    chosen, _ = subject.chosen(found, words, view.PROG, view.ViewOptions)
    return opening.open_window(found, chosen, options)


def only_line(capsys) -> str:
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and "Traceback" not in said
    return said


# --- the program ---


@pytest.fixture(scope="module")
def made(trained):
    run = load(trained)
    brain = run.state
    driver = policy_driver(functools.partial(planner.guide, run.config, run.network), brain)
    options = run.experiment.env

    def make(numbers):
        build_env = run.experiment.build_env
        return build_program(build_env, replaced(options, numbers), "c", driver, brain)

    return run, brain, make


@pytest.mark.slow
def test_a_live_number_does_what_a_new_environment_does(made):
    run, brain, make = made
    program = make({})
    assert set(program.live) == {("bonus",), ("weights", 0), ("weights", 1), ("limit",)}
    assert set(program.fixed) == {("width",), ("span", 0), ("span", 1)}
    changed = {("bonus",): 3.5, ("weights", 1): 0.125}
    built = make(changed)
    slid = open_session(program, brain, "", 100, 4)
    slid = slid._replace(numbers=slid.numbers | changed)
    fresh = open_session(built, brain, "", 100, 4)
    for _ in range(5):
        slid, fresh = take_step(slid), take_step(fresh)
    assert slid.rows[-1].reward == pytest.approx(fresh.rows[-1].reward, abs=1e-6)
    assert slid.rows[-1].metrics["reward_bonus"] == 3.5
    # It acts as the run's own policy does.
    first = run.env.reset(jax.random.fold_in(episode_key(4, 0), 0))
    run.policy.reset()
    np.testing.assert_allclose(slid.rows[0].action, run.policy(first.observation), atol=1e-6)


@pytest.mark.slow
def test_options_that_break_a_rule_are_one_line(made):
    _, _, make = made
    with pytest.raises(UserError, match=r"width is 2.0; it must be above 0 and below 1."):
        make({("width",): 2.0})


@dataclasses.dataclass(frozen=True)
class Nothing:
    """The options of an environment without any."""


@pytest.mark.slow
def test_an_environment_without_options_has_no_sliders(made):
    run, brain, _ = made
    driver = policy_driver(functools.partial(planner.guide, run.config, run.network), brain)

    def build(options, engine):
        return sled.build(sled.Options(bonus=2.5), engine)

    program = build_program(build, Nothing(), "c", driver, brain)
    session = take_step(open_session(program, brain, "", 100, 0))
    assert session.numbers == {} and session.rows[0].metrics["reward_bonus"] == 2.5


@pytest.mark.slow
def test_the_planner_drives_an_experiment(trained):
    """By the best of its plans: to be still at x = 0 costs least, and a push is braked."""
    options = view.ViewOptions(samples=32, horizon=10, seed=1)
    session, source, title = open_with(options, Path(sled.__file__))
    assert title == "sled_experiment" and source.checkpoints() == ()
    session = advance(session, [(push, (1.0, 0.0, 0.0)), (step,)])
    for _ in range(40):
        session = take_step(session)
    speeds = [-row.metrics["reward_slow"] / 0.25 for row in session.rows]
    assert speeds[0] > 0.9 and speeds[-1] < 0.5 * speeds[0]
    assert all(row.action[0] < 0 for row in session.rows[:5])
    # Of a run, plans begin with what the policy does.
    of_run = view.ViewOptions(drive="planner", samples=8, horizon=2)
    session, source, _ = open_with(of_run, trained)
    assert take_step(session).length == 1
    assert source.command({("bonus",): 2.0}).endswith("sled_experiment.py --env.bonus 2.0")
    assert source.words({("span", 0): 1.0}) == source.command({("span", 0): 1.0})
    assert source.words({("span", 0): 1.0}) == "span is (1.0, 1.0); give least < greatest."
    with pytest.raises(UserError, match="is no run's folder"):
        open_with(dataclasses.replace(options, drive="policy"), Path(sled.__file__))


@pytest.mark.slow
@pytest.mark.parametrize("of", ["experiment", "run"])
def test_the_sliders_begin_where_the_command_line_puts_them(trained, of):
    name = trained if of == "run" else Path(sled.__file__)
    options = view.ViewOptions(samples=8, horizon=2)
    session, source, _ = open_with(options, name, "--env.bonus", "3", "--env.width", "0.25")
    assert session.numbers[("bonus",)] == 3.0 and session.numbers[("width",)] == 0.25
    assert take_step(session).rows[-1].metrics["reward_bonus"] == 3.0
    assert source.words(session.numbers) == "--env.bonus 3.0 --env.width 0.25"


def test_help_needs_no_package_that_draws(monkeypatch, capsys):
    find = importlib.util.find_spec
    absent = lambda name, *of: None if name == "viser" else find(name, *of)  # noqa: E731
    monkeypatch.setattr("importlib.util.find_spec", absent)
    with pytest.raises(SystemExit, match="^0$"):
        view.main(["cartpole_swingup", "--help"])
    assert "--horizon" in capsys.readouterr().out
    assert view.main(["cartpole_swingup"]) == USAGE
    assert "'.[view]'" in only_line(capsys)


@pytest.mark.slow
@needs_viser
def test_mistakes_are_one_line_and_nothing_in_the_run_changes(trained, tmp_path, capsys):
    assert view.main([str(tmp_path / "none")]) == USAGE
    assert "none" in only_line(capsys)
    copy = tmp_path / "one"
    shutil.copytree(trained, copy)
    (copy / "checkpoints" / "000000000003" / "meta.json").write_text("{}")
    assert view.main([str(copy), "--checkpoint", "3", "--port", "0"]) == USAGE
    assert "damaged" in only_line(capsys)
    assert view.main([str(trained), "--host", "203.0.113.1"]) == USAGE
    assert "203.0.113.1:8080 cannot be listened on" in only_line(capsys)


# --- the page ---


@contextlib.contextmanager
def opened(trained: Path):
    """Starts the command; gives its process and the page's address."""
    words = [sys.executable, "-u", "-m", "purerl.view", str(trained), "--port", "0"]
    process = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        line = next(line for line in process.stdout if "open http" in line)
        yield process, line.split("open ")[1].split()[0]
    finally:
        process.kill()
        process.wait(30)


def _below(label: str, floors: range) -> str:
    """Finds the element e that stands so many floors below an element that begins with a label."""
    said = f".textContent.replace(/\\u200b/g, '').startsWith({json.dumps(label)})"
    return " || ".join(f"e{'.parentElement' * n}{said}" for n in floors)


class Window:
    """The page as a person sees and moves it."""

    def __init__(self, browser: chromium.Browser, url: str) -> None:
        self.browser = browser
        browser.open(url, 920, 320)  # small: it is drawn without a GPU
        self.wait(lambda: "step " in self.text())
        # What the page says of a machine without a GPU would lie over the scene.
        browser.value("document.querySelectorAll('[class*=Notification]').forEach(e => e.remove())")

    def text(self) -> str:
        return self.browser.value("document.body.innerText").replace("\u200b", "")

    def wait(self, so, seconds: float = 90.0) -> None:  # of a machine that has other work
        end = time.monotonic() + seconds
        while not so():
            assert time.monotonic() < end, self.text()
            time.sleep(0.1)

    def steps(self) -> int:
        return int(self.text().split("step ")[-1].split(",")[0])

    def row(self, name: str) -> list[float]:
        """The numbers of a line of the table."""
        line = next(x for x in self.text().splitlines() if x.split()[:1] == [name])
        return [float(x) for x in line.split()[1:3]]

    def click(self, words: str) -> None:
        self._mark(f"e.textContent == {json.dumps(words)}", "button")
        self.browser.click("#marked")

    def place(self, find: str, kind: str) -> float:
        """How far an element is below the top of its panel [pixels]."""
        self._mark(find, kind)
        return self.browser.value(
            """(() => { const e = document.querySelector('#marked');
            const top = (x) => x.getBoundingClientRect().top;
            return top(e) - top(e.closest('[class*=ScrollArea-content]')) })()"""
        )

    def places(self) -> tuple[float, float]:
        """Where the button that plays is, and the first slider."""
        button = self.place("['Play', 'Pause'].includes(e.textContent)", "button")
        return button, self.place(_below("bonus", range(5, 9)), "[role=slider]")

    def tick(self, label: str) -> None:
        self._mark(_below(label, range(1, 9)), "input[type=checkbox]")
        self.browser.click("#marked")

    def choose(self, label: str, option: str) -> None:
        self._mark(f"e.value == {json.dumps(label)}", "input")
        self.browser.click("#marked")
        find = f"e.textContent == {json.dumps(option)} && e.offsetParent"  # of the open list
        self.wait(lambda: self._mark(find, "[role=option]", must=False))
        self.browser.click("#marked")

    def press(self, slider: str, key: str) -> None:
        """Presses a key on a slider: End is its greatest value."""
        self._mark(_below(slider, range(5, 9)), "[role=slider]")
        self.browser.value("document.querySelector('#marked').focus()")
        for kind in ("keyDown", "keyUp"):
            self.browser.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def _mark(self, find: str, kind: str, must: bool = True) -> bool:
        found = self.browser.value(
            f"""(() => {{ document.querySelector('#marked')?.removeAttribute('id');
            const e = [...document.querySelectorAll('{kind}')].find(e => {find});
            if (e) e.id = 'marked'; return !!e }})()"""
        )
        assert found or not must, (find, self.text())
        return found

    def drawn(self, path: Path) -> np.ndarray:
        """The pixels of the scene."""
        self.browser.picture(path, whole=False)
        box = self.browser.value(
            "document.querySelector('canvas').getBoundingClientRect().toJSON()"
        )
        self.center = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
        with Image.open(path) as image:
            part = (box["left"], box["top"], box["right"], box["bottom"])
            return np.asarray(image.convert("RGB").crop(tuple(map(int, part))), int)


def play(window: Window, tmp_path: Path) -> None:
    """What a person does; each thing is seen before the next."""
    assert "of update 3 (96 steps)" in window.text()
    places = window.places()
    # It moves, until it is told not to, and then step by step.
    steps = window.steps()
    window.wait(lambda: window.steps() > steps)
    window.click("Pause")
    window.wait(lambda: "paused" in window.text())
    steps = window.steps()
    window.click("Step")
    window.wait(lambda: window.steps() == steps + 1)
    # A slider changes the reward of the very next step, and says how to train so.
    assert window.row("bonus")[0] == 1.0
    window.press("bonus", "End")
    window.wait(lambda: "--env.bonus 4.0" in window.text())
    assert window.places() == places  # they stay under the mouse
    window.click("Step")
    window.wait(lambda: window.row("bonus")[0] == 4.0)
    window.click("Train this")
    window.wait(lambda: "purerl.run" in window.text())
    # Another checkpoint.
    window.choose("latest", "1")
    window.wait(lambda: "of update 1 (32 steps)" in window.text())
    # Without shadows the ground below the box is lighter.
    shaded = window.drawn(tmp_path / "shaded.png")
    window.tick("Shadows")
    window.wait(lambda: window.drawn(tmp_path / "plain.png").sum() > shaded.sum())
    # The mouse holds the box and draws it up.
    still = window.drawn(tmp_path / "still.png")
    window.click("Play")
    x, y = window.center
    window.browser.drag([(x, y), (x, y - 20), (x, y - 60)])
    window.wait(lambda: window.row("height")[0] > 0.05)
    assert np.abs(window.drawn(tmp_path / "moved.png") - still).max() > 60
    window.browser.drop((x, y - 60))
    # A number that shapes the model takes a new program, and a broken rule is told.
    window.press("width", "End")
    window.wait(lambda: "width is 1.2" in window.text())
    window.press("span[0]", "End")
    window.wait(lambda: "span is (1.0, 1.0)" in window.text())
    window.wait(lambda: "--env.bonus 4.0" in window.text())
    # An environment that ends at once.
    window.press("limit", "Home")
    window.wait(lambda: "ends at its first step" in window.text())
    # Whatever the page has said, and it has said more and more, the button is where it was.
    assert window.places()[0] == places[0]


@pytest.mark.slow
@needs_viser
@needs_chromium
def test_a_person_plays_with_a_run(trained, tmp_path):
    before = {p: p.stat().st_mtime_ns for p in trained.rglob("*") if p.is_file()}
    with opened(trained) as (process, url):
        assert url.startswith("http://127.0.0.1:")
        with chromium.browser(*GL) as browser:
            play(Window(browser, url), tmp_path)
            thrown = [e for e in browser.said if e["method"] == "Runtime.exceptionThrown"]
            assert not thrown, thrown[0]["params"]["exceptionDetails"]["exception"]["description"]
            assert all(u.startswith((url, "data:", "blob:")) for u in browser.requested)
        assert any("The last browser left" in line for line in process.stdout)
    assert {p: p.stat().st_mtime_ns for p in trained.rglob("*") if p.is_file()} == before
