"""Carries out run commands one after another in one process, which compiles programs once.

`commands.py` starts it, with `shim.c` before it, and writes a request a line, as JSON. The answers
go where standard output went.
"""

import contextlib
import faulthandler
import gc
import io
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tests.faults import shim


class _Said(io.StringIO):
    """What a command prints; calls `then` when it has printed a text."""

    def __init__(self, awaited: str | None, then: Callable[[], None]) -> None:
        super().__init__()
        self.awaited, self.then = awaited, then

    def write(self, text: str) -> int:
        length = super().write(text)
        if self.awaited is not None and self.awaited in text:
            self.awaited = None
            self.then()
        return length


def main() -> None:
    """Answers requests until there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print themselves is no answer
    faulthandler.register(signal.SIGUSR1)
    keep_programs()
    for line in sys.stdin:
        print(json.dumps(carry_out(**json.loads(line))), file=answers, flush=True)


def carry_out(
    words: list[str],
    root: str,
    record: str | None,
    trace: str | None,
    fault: list[Any] | None,
    stop_at: str | None,
    armed_at_stop: bool,
) -> dict[str, Any]:
    """Runs a command.

    Args:
      words: of `python -m purerl.run`.
      root: files below it are recorded, traced, and fail.
      record: where changes are appended, if anywhere.
      trace: where calls are appended, if anywhere.
      fault: what fails, if anything.
      stop_at: a text; when it is printed, the command gets SIGTERM.
      armed_at_stop: whether all this begins only then.
    """
    from purerl import run

    paths = [Path(path) if path else None for path in (record, trace)]
    broken = shim.Fault(tuple(fault[0]), *fault[1:]) if fault else None

    def arm() -> None:
        shim.arm(Path(root), *paths, broken)

    def stop() -> None:
        if armed_at_stop:
            arm()
        os.kill(os.getpid(), signal.SIGTERM)

    out, err, code = _Said(stop_at, stop), io.StringIO(), None
    before = set(threading.enumerate())
    begin = time.monotonic()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        if not armed_at_stop:
            arm()
        try:
            code = run.main(words)
        except BaseException:  # a command tells its errors in one line
            traceback.print_exc()
        fired = shim.disarm()
        gc.collect()  # what an exception held, a lock among it, as at the end of a process
        gc.freeze()  # what is left, most of it JAX's and its programs', is not looked through again
        stuck = busy_after(set(threading.enumerate()) - before)
    answer = {"code": code, "out": out.getvalue(), "err": err.getvalue(), "fired": fired}
    return answer | {"stuck": stuck, "seconds": time.monotonic() - begin}


def busy_after(threads: Iterable[threading.Thread], seconds: float = 3.0) -> str:
    """Returns where a thread is that would keep this process from ending, "" if there is none.

    What they print while one waits for them belongs to the command.
    """
    end = time.monotonic() + seconds
    for thread in threads:
        while not thread.daemon and thread.is_alive():
            frame = sys._current_frames().get(thread.ident or 0)
            # A pool's thread without work ends with the process.
            if frame is None or frame.f_code.co_name == "_worker":
                break
            if time.monotonic() > end:
                return f"{thread.name}: {''.join(traceback.format_stack(frame))}"
            time.sleep(0.01)
    return ""


def keep_programs() -> None:
    """Lets commands with the same settings share the compiled programs."""
    from purerl.training import seeds

    compile_programs, made = seeds.compile_programs, dict[str, Any]()

    def kept(
        config: Any,
        env: Any,
        network: Any,
        evaluation: Any,
        fresh: bool,
        *rest: Any,
        **options: Any,
    ) -> Any:
        key = repr((type(env), config, evaluation, rest, options))
        if key not in made:
            made[key] = compile_programs(config, env, network, evaluation, True, *rest, **options)
        return made[key]

    seeds.compile_programs = kept


if __name__ == "__main__":
    main()
