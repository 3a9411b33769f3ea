"""Makes a mistake in this process, in a folder of its own, and returns what the user reads."""

import contextlib
import difflib
import io
import re
import shlex
import textwrap
import tomllib
from pathlib import Path
from typing import NamedTuple

import purerl
from purerl import __main__ as commands
from purerl.core import errors
from purerl.core.errors import SUCCESS

ROOT = Path(__file__).parents[2]

BODY = """<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
MINE = '''"""A point that is pushed to the middle: an experiment of somebody's own."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import purerl
from purerl import Physics, State, lookup, networks


@dataclasses.dataclass(frozen=True)
class Options:
    push: float = 0.1


class Env:
    control_timestep = 0.1
    action_size = 1

    def reset(self, key):
        position = jax.random.uniform(key, (2,))
        return self.state(position)

    def step(self, state, action):
        position = state.physics + 0.1 * action
        return self.state(position)

    def state(self, position):
        distance = jnp.abs(position[0])
        return State(
            physics=position,
            observation=position,
            reward=1.0 - distance,
            terminated=distance > 5.0,
            truncated=jnp.zeros((), bool),
            metrics={"distance": distance},
            task=(),
        )


def build_env(options, engine):
    return Env()


def build_network(options, observation, action_size):
    network = networks.mlp(options, observation, action_size)
    return network


experiment = purerl.Experiment(
    build_env=build_env,
    env=Options(),
    build_network=build_network,
    network=networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,)),
    ppo=purerl.Config(
        num_steps=128, num_envs=8, rollout_length=4, num_minibatches=2, episode_length=8
    ),
    evaluation=purerl.Evaluation(num_episodes=4, number=1),
)
'''


class Mistake(NamedTuple):
    """One mistake, as table.toml describes it."""

    where: str
    title: str
    says: str
    command: str = "purerl run mine.py"
    instead: str = ""
    wrote: str = ""
    given: str = ""
    code: int = 2


def read_table() -> list[Mistake]:
    """Returns every mistake, in the order of the page."""
    found = tomllib.loads((Path(__file__).parent / "table.toml").read_text())["mistake"]
    return [Mistake(**one) for one in found]


def prepare(place: Path, mistake: Mistake) -> None:
    """Writes the user's files, with the mistake in them."""
    text = MINE
    if mistake.instead:
        assert text.count(mistake.instead) == 1, f"{mistake.instead!r} is not once in mine.py"
        text = text.replace(mistake.instead, mistake.wrote)
    (place / "mine.py").write_text(text)
    (place / "body.xml").write_text(BODY)


def make(mistake: Mistake) -> tuple[int, str]:
    """Makes the mistake in the present folder; returns the exit code and what was said.

    In Python the code is that of the error; any other error than one of purerl's goes on.
    """
    said = io.StringIO()
    code = SUCCESS
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        if mistake.command.startswith("purerl "):
            code = commands.main(shlex.split(mistake.command)[1:])
        else:
            try:
                exec(mistake.command, {"purerl": purerl})
            except (purerl.UserError, purerl.EnvError, AttributeError) as error:
                code = errors.USAGE
                said.write(f"{type(error).__name__}: {error}")
    return code, said.getvalue().replace(f"{Path.cwd()}/", "").replace(f"{ROOT}/", "").strip()


def agree(says: str, said: str) -> bool:
    """Tells whether what was said is what the table says, in which `...` is any text."""
    pattern = ".*".join(re.escape(part) for part in says.split("..."))
    return re.fullmatch(pattern, said) is not None


# --- the page ---

HEAD = """# Mistakes, and what you read then

Every mistake below is one that people make, and the line that it brings. A test makes each of them.
`...` stands for text that differs from machine to machine. Lines with `-` and `+` are in your
experiment's file: what should stand there, and what does. Commands end with exit code 2, unless
another is given. This page is made from the table `tests/mistakes/table.toml`.
"""


def page() -> str:
    """Returns the page of the site: every mistake, and the line that it brings."""
    parts, mistakes = [HEAD], read_table()
    for where in dict.fromkeys(mistake.where for mistake in mistakes):
        parts.append(f"## {where}\n")
        parts += [_entry(mistake) for mistake in mistakes if mistake.where == where]
    return "\n".join(parts)


def _entry(mistake: Mistake) -> str:
    """Returns a mistake's part of the page: what the user does, and what is said."""
    lines = [f"**{mistake.title}**", ""]
    if mistake.given:
        lines[0] += f" ({mistake.given})"
    if mistake.code != errors.USAGE:
        lines[0] += f", exit code {mistake.code}"
    if mistake.instead:
        changed = difflib.ndiff(mistake.instead.splitlines(), mistake.wrote.splitlines())
        shown = [line for line in changed if not line.startswith("?")]
        lines += ["```diff", *shown, "```", ""]
    if not mistake.instead or mistake.command != "purerl run mine.py":
        lines += ["```text", *mistake.command.splitlines(), "```", ""]
    quoted = textwrap.wrap(mistake.says, 96, break_long_words=False, break_on_hyphens=False)
    return "\n".join([*lines, *(f"> {line}" for line in quoted), ""])
