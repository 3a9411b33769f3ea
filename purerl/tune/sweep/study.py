"""Points that Optuna chooses by the scores so far; its own storage keeps them in the folder."""

import contextlib
import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, one_line
from purerl.tune.sweep.points import Point
from purerl.tune.sweep.spaces import Space

FILE = "optuna.db"
FIRST = 10  # points that Optuna's sampler draws before it looks at scores


def open_study(folder: Path | None) -> Any:
    """Opens the study of a sweep's folder, or one that nobody keeps (None)."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=UserWarning, module="optuna")
    storage = None
    if folder:
        # Connected to by path: in a URL, characters of a name are syntax.
        place = (folder / FILE).absolute()
        how = {"creator": lambda: sqlite3.connect(place, check_same_thread=False)}
        storage = optuna.storages.RDBStorage("sqlite://", engine_kwargs=how)
    return optuna.create_study(
        study_name="sweep", storage=storage, direction="maximize", load_if_exists=True
    )


@contextlib.contextmanager
def kept(folder: Path) -> Iterator[None]:
    """Turns a disk's refusal of what a sweep's study writes into a UserError."""
    try:
        yield
    except Exception as error:
        if not {"optuna", "sqlalchemy"} & {type(error).__module__.partition(".")[0]}:
            raise
        raise UserError(f"{folder / FILE} cannot be written: {one_line(error):.200}") from error


def known(study: Any, spaces: Sequence[Space]) -> list[Point]:
    """Returns the points chosen so far; one that a kill left half chosen is none."""
    names = {space.setting for space in spaces}
    trials = study.get_trials(deepcopy=False)
    return [_point(trial, spaces) for trial in trials if names == trial.params.keys()]


def propose(study: Any, spaces: Sequence[Space], number: int) -> Iterator[Point]:
    """Yields the points without a score, then new ones until there are `number`."""
    from optuna.trial import TrialState

    trials = study.get_trials(deepcopy=False)
    open_ones = {trial.number for trial in trials if trial.state != TrialState.COMPLETE}
    yield from (point for point in known(study, spaces) if point.number in open_ones)
    while len(known(study, spaces)) < number:
        study.sampler = _sampler(len(study.get_trials(deepcopy=False)))
        trial = study.ask({space.setting: _distribution(space) for space in spaces})
        yield _point(trial, spaces)


def tell(study: Any, point: Point, score: float) -> None:
    """Notes a point's score.

    Of a point that failed nothing is told: Optuna takes no score of one that it knows as failed,
    and the next command tries it once more.
    """
    if not study.get_trials(deepcopy=False)[point.number].state.is_finished():
        study.tell(point.number, score)


def _sampler(seed: int) -> Any:
    """Returns a sampler of one point: a sweep that goes on draws what it would have drawn."""
    from optuna.samplers import TPESampler

    return TPESampler(seed=seed, n_startup_trials=FIRST)


def _distribution(space: Space) -> Any:
    from optuna import distributions as known

    if space.choices:
        return known.CategoricalDistribution(space.choices)
    if space.whole:
        return known.IntDistribution(round(space.low), round(space.high), log=space.log)
    return known.FloatDistribution(space.low, space.high, log=space.log)


def _point(trial: Any, spaces: Sequence[Space]) -> Point:
    # Of a float every digit.
    return Point(trial.number, {s.setting: str(trial.params[s.setting]) for s in spaces})
