"""SIGTERM and SIGINT as a question that a loop asks: was it told to stop?"""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from purerl.machine import output


@contextmanager
def stop_signals(
    end: Callable[[int], Any], then: str = "finishing this chunk, then saving"
) -> Iterator[Callable[[], bool]]:
    """Yields a question: did SIGTERM or SIGINT ask to stop? A second signal calls `end(exit code)`.

    `then` is what is told at the first.

    Only the main thread receives signals: in another one the answer is always no.
    """
    received: list[int] = []

    def handle(number: int, frame: Any) -> None:
        if received:
            end(128 + number)
            return
        received.append(number)
        output.warn(f"\n{signal.Signals(number).name}: {then}. Once more to stop at once.")

    in_main = threading.current_thread() is threading.main_thread()
    with handling((signal.SIGTERM, signal.SIGINT) if in_main else (), handle):
        yield lambda: bool(received)


@contextmanager
def handling(numbers: Iterable[int], handle: Callable[[int, Any], Any]) -> Iterator[None]:
    """Has signals handled by `handle(number, frame)`, as long as this lasts."""
    old = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
