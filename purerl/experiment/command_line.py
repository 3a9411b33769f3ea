"""Command lines from dataclasses, by tyro, with one-line errors."""

import contextlib
import dataclasses
import enum
import io
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import tyro

from purerl.core.errors import SUCCESS, USAGE, RunError, StoppedError, UserError, nearest
from purerl.experiment import other_trainers, settings_json
from purerl.experiment.definition import Experiment, shrunk
from purerl.experiment.loading import Source, available, find_source, summary
from purerl.experiment.options import RunOptions
from purerl.machine import command_errors, output

CONFIG = (tyro.conf.FlagCreatePairsOff,)
# A flag takes a word, True or False, as every other option does.
WORDS = (tyro.conf.FlagConversionOff,)
RULES = tyro.constructors.ConstructorRegistry()
# Gives back an experiment with the overrides of a command line, and the command's options.
Over = Callable[..., tuple[Experiment, Any]]


def main_of(kind: Any, command: Callable[[Any], int | None], prog: str) -> Callable[..., int]:
    """Returns a command's `main`, which tells an error in one line.

    Args:
      kind: the dataclass of its options.
      command: called with them; what it returns is the exit code, None: 0.
      prog: the command's words, for the help page.
    """

    return _main(lambda words: command(parse(kind, words, prog)))


def main_of_words(
    command: Callable[[list[str]], int | None], show_help: Callable[[list[str]], Any]
) -> Callable[..., int]:
    """Returns the `main` of a command whose first word says what it is about, or asks for help.

    Args:
      command: called with the words; what it returns is the exit code, None: 0.
      show_help: called with them where there is none, or the first asks for it.
    """

    def run(words: list[str]) -> int | None:
        if words and words[0] not in ("-h", "--help"):
            return command(words)
        show_help(words)
        return SUCCESS if words else USAGE

    return _main(run)


def _main(run: Callable[[list[str]], int | None]) -> Callable[..., int]:
    def main(arguments: Sequence[str] | None = None) -> int:
        try:
            return run(sys.argv[1:] if arguments is None else list(arguments)) or SUCCESS
        except (UserError, RunError, StoppedError) as error:
            return command_errors.tell(error)

    return main


def read_experiment(
    words: Sequence[str], prog: str, base: Any = RunOptions, **more: Any
) -> tuple[Source, Experiment, Any]:
    """Returns the experiment that the first word names, and what the others make of it.

    Args:
      words: the command line.
      prog: the command before it.
      base: the dataclass of the command's options.
      more: for `from_command_line`.

    Raises:
      UserError: there is no such experiment or option, or a value is wrong.
    """
    if words[0].startswith("-"):
        raise UserError(f"The first word must be the experiment, not {words[0]}: {prog} EXPERIMENT")
    source = find_source(words[0])
    prog = f"{prog} {shlex.quote(words[0])}"
    return source, *from_command_line(source, words[1:], prog, base=base, **more)


def from_command_line(
    source: Source,
    arguments: Sequence[str],
    prog: str,
    config: Any = CONFIG,
    base: Any = RunOptions,
    names: Sequence[str] = (),
    choose: Callable[[Source, Over], tuple[Experiment, Any]] | None = None,
) -> tuple[Experiment, Any]:
    """Returns the experiment with its overrides, and the command's options.

    Args:
      source: the experiment.
      arguments: the command line after the experiment's name.
      prog: the command before `arguments`, for the help page and for errors.
      config: tyro's markers.
      base: the dataclass of the command's options.
      names: of the experiment's settings that can be overridden; none: all.
      choose: says over what, where that is not what the experiment's file has.

    Raises:
      UserError: there is no such option, or a value is wrong.
    """

    def over(experiment: Experiment, **more: Any) -> tuple[Experiment, Any]:
        values = settings_json.settings_of(experiment)
        values = {name: values[name] for name in names or values}
        kinds = {f.name: f.type for f in dataclasses.fields(Experiment)}
        kinds |= {name: type(v) for name, v in values.items() if dataclasses.is_dataclass(v)}
        # A class made for this experiment: its settings have the types of their values, which is
        # all that the command line needs to know: an environment's options need no registration.
        fields = [(name, kinds[name], dataclasses.field(kw_only=True)) for name in values]
        both = dataclasses.make_dataclass("Settings", fields, bases=(base,), frozen=True)
        both.__doc__ = summary(source.path) or f"Experiment {source.name}."
        parsed = parse(both, arguments, prog, both(**values, **more), config)
        overrides = {name: getattr(parsed, name) for name in values}
        options = {f.name: getattr(parsed, f.name) for f in dataclasses.fields(base)}
        return dataclasses.replace(experiment, **overrides), base(**options)

    chosen, options = choose(source, over) if choose else over(source.experiment)
    # Tiny sizes, but for those that were given.
    debug = getattr(options, "debug", False)
    return over(shrunk(source.experiment)) if debug else (chosen, options)


def from_settings(
    source: Source, settings: Mapping[str, Any], options: Mapping[str, Any], **more: Any
) -> tuple[Experiment, RunOptions]:
    """Returns the same as `from_command_line`, checked in the same way, from Python values.

    Args:
      source: the experiment.
      settings: "ppo.num_envs" -> value.
      options: "num_seeds" -> value.
      more: for `from_command_line`.
    """
    if not isinstance(settings, Mapping):
        raise UserError(f"settings is {settings!r}; give a dict, such as {{'ppo.gamma': 0.99}}.")
    for name, value in settings.items():
        held = getattr(source.experiment, name, None)
        if isinstance(value, Mapping) and dataclasses.is_dataclass(held):
            dotted = {f"{name}.{inner}": one for inner, one in value.items()}
            raise UserError(f"Settings of {name} have dotted names: give {dotted}.")
    words = [word for pair in {**settings, **options}.items() for word in _words(*pair)]
    known = shlex.quote(source.name if source.name in available() else str(source.path))
    return from_command_line(source, words, f"python -m purerl.run {known}", WORDS, **more)


def _words(name: str, value: Any) -> list[str]:
    """Returns an option of the command line with its value."""
    if isinstance(value, Mapping):
        value = [part for pair in value.items() for part in pair]
    parts = value if isinstance(value, list | tuple) else [value]
    texts = [part.name if isinstance(part, enum.Enum) else str(part) for part in parts]
    return [f"--{name.replace('_', '-')}", *texts]


def parse(
    kind: Any, words: Sequence[str], prog: str, base: Any = None, config: Any = CONFIG, **more: Any
) -> Any:
    """Parses a command line into the dataclass `kind`; `--help` prints a page and exits.

    What the words do not give is as in `base`; `more` is for `tyro.cli`, such as
    `return_unknown_args=True`.

    Raises:
      UserError: there is no such option (the message has the nearest one), or a value is wrong.
    """
    said = io.StringIO()
    extra = {"registry": RULES} | ({} if base is None else {"default": base})
    try:
        with output.answering(), contextlib.redirect_stderr(said):
            return tyro.cli(kind, args=list(words), prog=prog, config=config, **extra, **more)
    except SystemExit as error:
        if not error.code:
            raise
        what = _one_line(said.getvalue(), _option_names(kind, base), base)
        raise UserError(f"{what} All options: {prog} --help") from error


@RULES.struct_rule
def _of_annotated_kind(info: Any) -> Any:
    """Lets an entry of a dict be of each annotated kind: tyro takes that of its default alone."""
    kinds, default = get_args(info.type), info.default
    if not (isinstance(default, dict) and default and get_args(kinds and kinds[-1])):
        return None
    field = tyro.constructors.StructFieldSpec
    fields = tuple(field(name, kinds[-1], value) for name, value in default.items())
    return tyro.constructors.StructConstructorSpec(dict, fields)


def _entries(option: str, value: Any) -> str:
    """Returns which entries a dict of the settings has, where an option names another, or none."""
    path = option[2:].replace("-", "_").split(".")
    for i, word in enumerate(path):
        if isinstance(value, dict) and word not in value:
            names = f"{'.'.join(path[:i])} names {', '.join(value) or 'none'}"
            return f"{names}: name others in the experiment's file."
        value = value[word] if isinstance(value, dict) else getattr(value, word, None)
    if isinstance(value, dict) and value:
        return f"Give its entries by name: {', '.join(f'{option}.{name}' for name in value)}."
    return ""


def _one_line(text: str, names: list[str], base: Any) -> str:
    """Returns tyro's framed, coloured message as one line: what is wrong, and the nearest fix."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    plain = " ".join(re.sub(r"[─-╿]|-{5,}", " ", text).split())
    unknown = re.search(r"Unrecognized options: (\S+?)[,=]? ", plain)
    if unknown:
        if unknown[1] in ("True", "False"):
            return "A switch takes no value: give its option alone, or leave it out."
        entries = _entries(unknown[1], base)
        if unknown[1] in names and not entries:
            group, dot, name = unknown[1][2:].rpartition(".")
            return f"{unknown[1]} takes no value; --{group}{dot}no-{name} turns it off."
        if not unknown[1].startswith("-"):
            return f"{unknown[1]!r} follows no option; write one before it, as in --name x."
        hint = entries or other_trainers.suggest(unknown[1], names)
        return f"There is no option {unknown[1]}. {hint}".strip()
    titles = "Value error|Missing argument|Invalid choice|Parsing error|Required options"
    plain = re.sub(rf"^({titles}) ", "", plain)
    plain = re.sub(r" *(Argument helptext:|For full helptext).*", "", plain)
    for pattern, words in _IN_WORDS:
        plain = re.sub(pattern, words, plain)
    return plain.rstrip(".") + "." if plain else "The command line is wrong."


def _wrong_choice(found: re.Match[str]) -> str:
    value, option, choices = found.groups()
    near = nearest(value.strip("'"), re.findall(r"'([^']*)'", choices))
    hint = f"did you mean {near!r}? It" if near else "it"
    return f"{option} is {value}; {hint} must be one of {choices}"


# Python's words and tyro's, and ours.
_IN_WORDS: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^Error parsing (\S+): invalid literal .*?: (.*)", r"\1 is \2; it must be a whole number"),
    (r"^Error parsing (\S+): could not convert .*?: (.*)", r"\1 is \2; it must be a number"),
    (
        r"^Error parsing (\S+): Could not find valid parse for arguments: \[(.*)\]",
        r"\1 is \2; write numbers with spaces between them, such as 64 64",
    ),
    (
        r"^Error parsing (\S+): no type matching (.+?) could.*?\[(.*?)\].*",
        r"\1 is \3; it must be \2",
    ),
    (r"\|\{([A-Z ]+)\}", r" or \1"),  # FLOAT|{FLOAT FLOAT INT}
    (r"^invalid choice (.*) for argument '(\S+)'.*\((.*)\)", _wrong_choice),
    (r"^Missing from .*?: [A-Z.,\[\]{} ]+?(?=[A-Z][a-z'])", "The command lacks: "),
    (r" \(required\)", ""),
    (r"^Error parsing [\w-]+: ", ""),  # a rule of a dataclass, in its own words
)


def _option_names(kind: Any, default: Any, path: str = "--") -> list[str]:
    """Returns the options of a dataclass, those of dataclasses in it among them."""
    found = []
    for field in dataclasses.fields(kind):
        name, value = path + field.name.replace("_", "-"), getattr(default, field.name, None)
        inner = dataclasses.is_dataclass(value) and not isinstance(value, type)
        found += _option_names(value, value, f"{name}.") if inner else [name]
    return found
