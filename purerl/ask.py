r"""Asks a policy: `python -m purerl.ask RUN ... [--vary env.gap_length 0.1 0.2] [--lesion.layer L]`

N whole episodes in other conditions than those it was trained in: with any option of its
environment given, and at several values of one (a psychometric curve); with a lesion of its
network; or both. All begin from the same keys, at each value, with the lesion and without:

    python -m purerl.ask ant_gaps --env.arena single_gap --outcome landed_count \
        --vary env.gap_length 0.1 0.3 0.5
    python -m purerl.ask ant_gaps --lesion.layer policy/Dense_0 --vary lesion.share 0 0.25 0.5 1

Several runs, which differ in their seed alone, have a curve each, and one of their mean. RUN may be
a folder of runs, or a policy that comes with purerl.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from purerl.core.errors import UserError, check_least
from purerl.experiment.command_line import main_of_words
from purerl.experiment.options import EpisodeOptions, Lesion
from purerl.machine import command_errors, files, output
from purerl.tune import subject

PROG = "python -m purerl.ask"


@dataclass(frozen=True)
class AskOptions(EpisodeOptions):
    """What is asked, and what of the episodes is shown."""

    vary: tuple[str, ...] = ()
    """An option of env or lesion and its values, as env.x 1 2; of a range, a value is both ends."""
    outcome: str = "episode_return"
    """Which figure of an episode is shown: its return, or a metric of the environment."""
    episodes: int = 64
    """Whole episodes of each run under each condition, N."""
    out: Path = Path("answers.csv")
    """File to write, an episode a row; with --vary a picture too, of the same name in .png."""
    lesion: Lesion = Lesion()

    @property
    def varied(self) -> str:
        """What varies, spelt as a setting is; "": nothing."""
        return "".join(self.vary[:1]).replace("-", "_")


def command(words: Sequence[str]) -> None:
    """Asks, prints the figures, and writes the files."""
    from purerl.report import asking, comparison

    first, runs, words = subject.find_runs(words, PROG)
    experiment, options = subject.chosen(first, words, PROG, AskOptions)
    check_least(options, UserError, episodes=1)
    asked = asking.cases(first.source, experiment, options, f"{PROG} {first.name}")
    if options.out.suffix == ".png":
        raise UserError(f"{options.out} is the picture's name: give the table's, such as ask.csv.")
    for path in (options.out, options.out.with_suffix(".png")):
        files.check_new(path)
    answers = list(asking.ask(runs, asked, options))
    rows = asking.summarize(answers, options.outcome)
    table = comparison.table([(name, name) for name in asking.COLUMNS], rows)
    output.show(f"{options.outcome}, 95% intervals", *table, *asking.notes(answers, options.varied))
    files.write_answer(options.out, comparison.episodes_csv(answers))
    output.show(str(options.out))
    if options.varied:
        asking.draw(options.out.with_suffix(".png"), rows, options.varied, options.outcome)
        output.show(str(options.out.with_suffix(".png")))


main = main_of_words(command, lambda words: subject.show_help(AskOptions, __doc__, PROG, words))


if __name__ == "__main__":
    command_errors.leave(main)
