"""Lets everything go wrong at once, for as long as you like: kills, power cuts, faults, stops.

python -m tests.soak [--minutes 60] [--seed 0]

Each life of a run is disturbed in some way, drawn from the seed, and the next life goes on from
what it left, until nothing disturbs it any more. Then digest and metrics.jsonl (the clock aside)
must be those of a run that nobody disturbed, and no update that was said to be saved is lost. The
disturbances:

    kill    SIGKILL of the process at a random moment
    cut     the power fails after a random change of a file; what is left is one of five models
    fault   a random call fails, once or from then on
    both    a call fails, and some time later the power does
    stop    SIGTERM

The last lines are a table of what was survived. Exit code 0 if everything was.
"""

import argparse
import collections
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import SUCCESS
from tests.faults import disk, verdicts
from tests.faults.commands import Answer, Worker, fresh, workplace
from tests.faults.shim import Fault
from tests.faults.verdicts import NAME, STOP_AT, TOY, Whole, command, go_on
from tests.long.io_faults import ERRORS, LASTING, saved_by
from tests.long.kills import spawn
from tests.long.power_cuts import cuts_after

GO_ON = 0.6  # the chance that a life is followed by another one that is disturbed
STARTING = 0.25  # share of the kills that come while a process is starting
STOPS = ("bit-exact", "Compiled", STOP_AT)  # in what is printed; then comes SIGTERM
EXPERIMENTS = {
    "toy": [str(TOY), "--checkpoints", "5", "--keep", "2"],
    "two seeds": [str(TOY), "--checkpoints", "4", "--keep", "1", "--num-seeds", "2"],
    "cartpole": [
        "cartpole_swingup", "--ppo.num-steps", "60000", "--checkpoints", "6", "--keep", "1",
        "--evaluation.number", "3", "--evaluation.num-episodes", "2",
    ],
}  # fmt: skip


class Subject(NamedTuple):
    """An experiment that is disturbed."""

    whole: Whole
    starting: float  # [s] from the start of a process until its programs are compiled
    training: float  # [s] from there to its end
    calls: dict[str, int]  # how many of each kind it makes


class Scene(NamedTuple):
    """A run that is about to be disturbed."""

    worker: Worker
    subject: Subject
    place: Path
    draw: random.Random
    least: int  # the update that is known to be saved


class Life(NamedTuple):
    """What happened to one process."""

    how: str  # in words
    wrong: str  # "" if nothing was
    least: int  # the update that is known to be saved after it


class Story(NamedTuple):
    """A run from its first life to its last."""

    experiment: str
    lives: list[tuple[str, Life]]  # and how each was disturbed
    wrong: str
    said: str


def main() -> int:
    """Runs the soak; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("tests.soak", description=__doc__, formatter_class=plain)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long")
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn")
    options = parser.parse_args()
    with workplace() as (folder, worker):
        stories = soak(worker, folder, 60.0 * options.minutes, options.seed)
    print_table(stories, options.minutes)
    return 1 if any(story.wrong for story in stories) else 0


def soak(worker: Worker, folder: Path, seconds: float, seed: int) -> list[Story]:
    """Disturbs runs until the time is over; tells of each that does not survive."""
    end = time.monotonic() + seconds
    subjects = {name: prepare(worker, words, folder) for name, words in EXPERIMENTS.items()}
    stories: list[Story] = []
    while time.monotonic() < end:
        draw = random.Random(f"{seed} {len(stories)}")
        name = draw.choice(list(subjects))
        story = tell(worker, name, subjects[name], draw, fresh(folder / "run"))
        stories.append(story)
        if story.wrong:
            print(f"story {len(stories)}, {name}: {story.wrong}", flush=True)
            print("".join(f"  {life.how}\n" for _, life in story.lives) + story.said, flush=True)
        if len(stories) % 50 == 0:
            failed = sum(bool(story.wrong) for story in stories)
            lives = sum(len(story.lives) for story in stories)
            print(f"{len(stories)} runs, {lives} disturbances, {failed} failures", flush=True)
    return stories


def prepare(worker: Worker, words: list[str], folder: Path) -> Subject:
    """Makes the run without disturbing it, in the worker and in a process of its own."""
    trace = folder / "own" / "trace"
    trace.unlink(missing_ok=True)
    whole = verdicts.undisturbed(worker, words, fresh(folder / "run"), trace=trace)
    kinds = [line.split(" ")[0] for line in trace.read_text().splitlines()]
    begin = time.monotonic()
    process = spawn(words, fresh(folder / "run") / "runs", NAME)
    wait_for_training(process)
    first = time.monotonic()
    process.communicate()
    seconds = time.monotonic() - first
    return Subject(whole, first - begin, seconds, collections.Counter(kinds))


def tell(worker: Worker, name: str, subject: Subject, draw: random.Random, place: Path) -> Story:
    """Disturbs one run, life after life, and takes it to its end."""
    lives: list[tuple[str, Life]] = []
    least = 0
    while not lives or draw.random() < GO_ON:
        disturbance = draw.choice(list(DISTURBANCES))
        life = DISTURBANCES[disturbance](Scene(worker, subject, place, draw, least))
        lives.append((disturbance, life))
        least = life.least
        if life.wrong:
            return Story(name, lives, life.wrong, "")
    answer = worker.run(command(subject.whole.words, place), place)
    wrong = verdicts.complaint(answer, place, subject.whole)
    began = verdicts.began_at(answer, subject.whole)
    if not wrong and began < least:
        wrong = f"it goes on after update {began}, and {least} was said to be saved"
    return Story(name, lives, wrong, answer.said + answer.stuck)


# --- what may happen ---


def kill(scene: Scene) -> Life:
    """Kills a process of its own at a random moment."""
    draw, subject, place = scene.draw, scene.subject, scene.place
    starting = draw.random() < STARTING
    moment = draw.random() * (subject.starting if starting else subject.training)
    process = spawn(go_on(subject.whole.words, place), place / "runs", NAME)
    said = "" if starting else wait_for_training(process)
    time.sleep(moment)
    process.kill()
    said += process.communicate()[0]
    how = f"killed {moment:.2f} s after {'its start' if starting else 'it was compiled'}"
    if process.returncode == -signal.SIGKILL:
        return Life(how, "", scene.least)
    return judge(scene, f"{how}, too late", Answer(process.returncode, said, said))


def cut(scene: Scene, fault: Fault | None = None) -> Life:
    """Lets the power fail after a random change of a file."""
    draw, place, log = scene.draw, scene.place, scene.place.parent / "own" / "record"
    log.unlink(missing_ok=True)
    model = disk.Disk(place, begun=True)
    answer = go(scene, record=log, fault=fault)
    life = judge(scene, str(fault or ""), answer)
    if life.wrong:
        return life
    changes = disk.read_record(log)
    number, kind = draw.choice(sorted(cuts_after(changes, 10))), draw.choice(disk.MODELS)
    (tree,) = (tree for _, _, tree in disk.trees(model, changes, {number}, (kind,)))
    if model.tree("written") != disk.read_tree(place):
        if fault:  # a thread that a fault left behind may write on when nobody records any more
            return life
        raise RuntimeError("The record is not what the disk holds: some call was missed.")
    change = str(changes[number - 1]).replace(f"{place}/", "") if number else "nothing"
    disk.write_tree(tree, fresh(place))
    how = f"{life.how}, then cut {number} of {len(changes)} ({kind}), after {change}"
    return Life(how, "", life.least if number == len(changes) else scene.least)


def fault(scene: Scene) -> Life:
    """Lets a random call fail."""
    drawn = draw_fault(scene.subject, scene.draw)
    return judge(scene, str(drawn), go(scene, fault=drawn))


def both(scene: Scene) -> Life:
    """Lets a random call fail, and then the power."""
    return cut(scene, draw_fault(scene.subject, scene.draw))


def stop(scene: Scene) -> Life:
    """Asks a process to stop."""
    text = scene.draw.choice(STOPS)
    return judge(scene, f"asked to stop at {text!r}", go(scene, stop_at=text))


DISTURBANCES = {"kill": kill, "cut": cut, "fault": fault, "both": both, "stop": stop}


def go(scene: Scene, **options: Any) -> Answer:
    """Carries the run command out."""
    return scene.worker.run(command(scene.subject.whole.words, scene.place), scene.place, **options)


def judge(scene: Scene, how: str, answer: Answer) -> Life:
    """Says how a command ended."""
    whole = scene.subject.whole
    done = answer.code == SUCCESS
    wrong = verdicts.complaint(answer, scene.place, whole) if done else verdicts.untold(answer)
    met = f" (met {answer.fired.replace(f'{scene.place}/', '')})" if answer.fired else ""
    said = "done" if done else re.sub(r"\s+", " ", answer.err + answer.stuck)
    return Life(f"{how}{met}: {said}", wrong, saved_by(answer, whole, scene.least))


def draw_fault(subject: Subject, draw: random.Random) -> Fault:
    """Returns a random fault: a kind of call that the run makes, which of them, and how."""
    if draw.random() < 0.2:
        error = draw.choice(list(LASTING))
        calls = sum(subject.calls.get(kind, 0) for kind in LASTING[error])
        return Fault(LASTING[error], draw.randint(1, calls), error, once=False)
    kind = draw.choice([kind for kind in ERRORS if subject.calls.get(kind)])
    return Fault((kind,), draw.randint(1, subject.calls[kind]), draw.choice(ERRORS[kind]))


def wait_for_training(process: subprocess.Popen) -> str:
    """Waits until a process has compiled its programs, or is over; returns what it has said."""
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if line.startswith("Compiled"):
            break
    return said


def print_table(stories: list[Story], minutes: float) -> None:
    """Prints how many disturbances of each kind were survived, by experiment."""
    print(f"{'':10}" + "".join(f"{name:>10}" for name in (*DISTURBANCES, "runs", "failures")))
    for name in EXPERIMENTS:
        own = [story for story in stories if story.experiment == name]
        count = collections.Counter(kind for story in own for kind, _ in story.lives)
        failed = sum(bool(story.wrong) for story in own)
        numbers = [*(count[kind] for kind in DISTURBANCES), len(own), failed]
        print(f"{name:10}" + "".join(f"{number:10}" for number in numbers))
    failed = [story for story in stories if story.wrong]
    for kind, number in collections.Counter(
        verdicts.kind_of(s.wrong) for s in failed
    ).most_common():
        print(f"{number} x {kind}")
    lives = sum(len(story.lives) for story in stories)
    print(f"{len(stories) - len(failed)} of {len(stories)} runs, disturbed {lives} times in "
          f"{minutes:g} minutes, ended as undisturbed ones")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
