"""What a checkpoint costs: python -m tests.long.checkpoint_cost -- ant_run --ppo.num-envs 4096

What follows `--` is a command line of `python -m purerl.run`. Prints bytes and seconds, the median
of several: `holds up` is what training waits for (the copy to the host), `writes` happens meanwhile
in another thread (hashes, Orbax, fsync), `restores` is what a resumed run waits for.
"""

import argparse
import functools
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from purerl.devices import memory, programs
from purerl.devices.compilation import set_up_jax
from purerl.experiment import loading, objects
from purerl.experiment.command_line import from_command_line
from purerl.machine import state_arrays
from purerl.ppo import algorithm
from purerl.runs import checkpoint

TIMES = 5


def main() -> None:
    """Measures and prints."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.checkpoint_cost", description=__doc__, formatter_class=plain
    )
    parser.add_argument("words", nargs="+", help="-- EXPERIMENT [--option value ...]")
    words = parser.parse_args().words
    source = loading.find_source(words[0])
    chosen, _ = from_command_line(source, words[1:], "tests.long.checkpoint_cost")
    set_up_jax(True)
    setup = objects.build(chosen)
    state = jax.jit(functools.partial(algorithm.init, *setup[:3]))(jax.random.key(1))
    abstract = programs.abstract_state(*setup[:3])
    jax.block_until_ready(state)
    with tempfile.TemporaryDirectory() as folder:
        leaves, holds_up = median(lambda: state_arrays.flatten(state))
        meta = {
            "update": 1,
            "digest": state_arrays.digest_leaves(leaves),
            "steps": 0,
            "wall_s": 0.0,
        }
        meta |= {"metrics_bytes": 0, "metrics_sha256": ""}
        path, writes = median(lambda: checkpoint.save(Path(folder), leaves, meta))
        restored, restores = median(lambda: checkpoint.load_checkpoint(path, abstract).state)
        assert state_arrays.digest_leaves(state_arrays.flatten(restored)) == meta["digest"]
        on_disk = sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
    print(f"state     {memory.size(state):>12,} bytes in {len(leaves)} leaves")
    print(f"on disk   {on_disk:>12,} bytes")
    for name, seconds in (("holds up", holds_up), ("writes", writes), ("restores", restores)):
        print(f"{name:9} {seconds:12.4f} s")


def median(function: Callable[[], Any]) -> tuple[Any, float]:
    """Returns the last result and the median time [s]."""
    seconds = []
    for _ in range(TIMES):
        begin = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - begin)
    return result, statistics.median(seconds)


if __name__ == "__main__":
    main()
