"""Executes the blocks of a page, in order, in the present folder: `python -m tests.docs.play PAGE`.

`run` gives a page an empty folder and a process of its own.
"""

import atexit
import functools
import importlib
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.docs.blocks import GIVEN, ROOT, Block, blocks, command

# What is compiled for one page serves the next, and the tests.
COMPILED = os.path.join(tempfile.gettempdir(), "purerl-test-compilations")


def run(page: Path, timeout: float = 290.0) -> subprocess.CompletedProcess[str]:
    """Executes a page in an empty folder, with the clone importable as if it were installed."""
    with tempfile.TemporaryDirectory(prefix="purerl-page-") as folder:
        work, tools = Path(folder, "work"), Path(folder, "bin")
        work.mkdir()
        _write_commands(tools)
        environment = {
            **os.environ,
            "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "XDG_STATE_HOME": str(Path(folder, "state")),
        }
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", COMPILED)
        environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        for given in GIVEN.findall(page.read_text()):
            shutil.copytree(_trained(), work / given)
        words = [sys.executable, "-m", "tests.docs.play", str(page.resolve())]
        return subprocess.run(
            words, cwd=work, env=environment, text=True, timeout=timeout, capture_output=True
        )


@functools.cache
def _trained() -> Path:
    """Trains the cart-pole for some seconds, once for all pages; returns the run's folder."""
    place = Path(tempfile.mkdtemp(prefix="purerl-page-run-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    words = ["cartpole_swingup", "--ppo.num-steps", "40000", "--runs", str(place)]
    words += ["--evaluation.number", "2", "--evaluation.num-episodes", "4"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", COMPILED)
    command = [sys.executable, "-m", "purerl.run", *words]
    subprocess.run(command, check=True, env=environment, cwd=place, capture_output=True)
    return place / "cartpole_swingup" / "seed1"


def _write_commands(folder: Path) -> None:
    """Writes `python` and `purerl`, as an installation has them, for this interpreter."""
    folder.mkdir()
    for name, words in {"python": "", "purerl": "-m purerl "}.items():
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words}"$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)


def play(page: Path) -> None:
    """Executes a page's blocks here; those of Python share one namespace."""
    sys.path[0] = ""  # the present folder, wherever a block goes
    names = {"__name__": "__main__"}
    for block in blocks(page.read_text()):
        if block.marker == "not run" or block.lacks:
            continue
        if block.title:
            write(block)
        elif block.language == "bash":
            _bash(page, block)
        elif block.language == "python":
            # Empty lines before it: an error names the line of the page.
            code = "\n" * (block.line - 1) + block.code
            exec(compile(code, str(page), "exec"), names)


def write(block: Block) -> None:
    """Writes a block with a title to its file."""
    path = Path(block.title)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(block.code)
    importlib.invalidate_caches()


def _bash(page: Path, block: Block) -> None:
    """Executes a block of bash, and goes where it went."""
    print(f"{page.name}:{block.line}", flush=True)
    with tempfile.NamedTemporaryFile("r") as where:
        script = f"{command(block)}\npwd > {where.name}\n"
        done = subprocess.run(["bash", "-e", "-c", script], stdin=subprocess.DEVNULL)
        if done.returncode:
            sys.exit(f"{page}, line {block.line}: exit code {done.returncode}\n{command(block)}")
        os.chdir(where.read().strip())


if __name__ == "__main__":
    play(Path(sys.argv[1]))
