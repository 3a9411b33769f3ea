"""Pages that are made from the code.

`SETTINGS`, the records' fields and comments, is a file: `python -m tests.docs --write` writes it,
and a test compares it. `OF_THE_SITE` are long lists, made when the site is built: what `--help` of
each command says, and the table of mistakes.
"""

import ast
import contextlib
import importlib
import inspect
import io
import os
from collections.abc import Iterator
from unittest import mock

from purerl.__main__ import COMMANDS, module_of
from purerl.experiment import definition, options
from purerl.ppo import config, networks
from tests.docs.blocks import ROOT
from tests.mistakes.play import page as mistakes

SETTINGS = ROOT / "docs/reference/settings.md"
SETTINGS_HEAD = """# Settings

`python -m tests.docs --write` writes this page from the code. All settings of an experiment, those
of its environment too, are listed with its own values: `python -m purerl.run ant_run --help`.

A setting has one name: `ppo.gamma` in Python and in `config.json`, `--ppo.gamma` on the command
line. What has no default here is the experiment's to say.
"""
HELP_HEAD = """# Options of the commands

What `--help` of each command says, written when this site was built. [Commands](commands.md) is the
overview.
"""
TABLES = {
    "ppo": (config.Config, "The algorithm. [The equations](../explanation/episodes.md) use these."),
    "evaluation": (config.Evaluation, "Evaluations during training."),
    "network": (networks.MlpOptions, "Of `networks.mlp`."),
    "network ": (networks.RecurrentOptions, "Of `networks.recurrent`."),
    "parts.NAME": (definition.Part, "[A part of the network](../howto/network_parts.md)."),
    "run": (options.RunOptions, "How a run is made, kept and shown: `--resume`, without a prefix."),
}


def fields(record: type) -> Iterator[tuple[str, str, str]]:
    """Yields name, default and comment of a dataclass's fields, those that it inherits first."""
    for kind in reversed(record.__mro__[:-1]):
        body = ast.parse(inspect.getsource(kind)).body[0].body  # type: ignore[attr-defined]
        for field, comment in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(comment, ast.Expr):
                default = ast.unparse(field.value) if field.value else ""
                default = "{}" if "default_factory=dict" in default else default
                words = " ".join(inspect.cleandoc(comment.value.value).split())  # type: ignore
                yield ast.unparse(field.target), default, words


def settings() -> str:
    """Returns docs/reference/settings.md."""
    parts = [SETTINGS_HEAD]
    for name, (record, about) in TABLES.items():
        prefix = "" if name == "run" else f"{name.strip()}."
        rows = [f"| `{prefix}{f}` | {f'`{d}`' if d else ''} | {c} |" for f, d, c in fields(record)]
        head = f"## {record.__name__}\n\n{about}\n\n| name | default | meaning |\n|---|---|---|\n"
        parts.append(head + "\n".join(row.replace("<", "&lt;") for row in rows) + "\n")
    return "\n".join(parts)


def help_of(command: str, *words: str) -> str:
    """Returns what `--help` of a command prints, 92 wide and without colours."""
    said = io.StringIO()
    plain = {"COLUMNS": "92", "NO_COLOR": "1", "TERM": "dumb"}
    module = importlib.import_module(f"purerl.{module_of(command)}")
    with (
        mock.patch.dict(os.environ, plain),
        contextlib.redirect_stdout(said),
        contextlib.suppress(SystemExit),
    ):
        module.main([*words, "--help"])
    return "\n".join(line.rstrip() for line in said.getvalue().strip().splitlines())


def commands() -> str:
    """Returns the page of the commands' options."""
    parts = [HELP_HEAD]
    for command in COMMANDS:
        parts.append(f"## {command}\n\n```text\n{help_of(command)}\n```\n")
        if command == "run":
            of = help_of("run", "cartpole_swingup")
            parts.append(f"### run cartpole_swingup\n\n```text\n{of}\n```\n")
    return "\n".join(parts)


OF_THE_SITE = {"reference/options.md": commands, "reference/mistakes.md": mistakes}
