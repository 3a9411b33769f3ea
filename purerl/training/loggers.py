"""Loggers, which are no part of a run: what they miss changes nothing.

TensorBoard and W&B have threads of their own, for which training never waits.
"""

import contextlib
import math
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from purerl.core.errors import one_line
from purerl.experiment.options import RunOptions
from purerl.machine.command_errors import check_installed
from purerl.machine.output import Say, say
from purerl.runs.folder import Folder, read
from purerl.runs.metrics_file import Record, read_metrics

MOST = 256  # records that may wait


class BackgroundLogger:
    """A sink (`log(record)`, `close()`) in a thread of its own.

    It is dropped, with one message, when it raises or lags.
    """

    def __init__(self, name: str, open_sink: Callable[[], Any], say: Say, size: int = MOST) -> None:
        """Opens the sink in the thread; `size` records may wait before it counts as too slow."""
        self.name, self.say = name, say
        self.queue: queue.Queue[Record | None] = queue.Queue(size)
        self.dropped = threading.Event()
        self.thread = threading.Thread(target=self._work, args=(open_sink,), daemon=True)
        self.thread.start()

    def log(self, record: Record) -> None:
        """Hands a record over; never waits."""
        if self.dropped.is_set():
            return
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self._drop(f"it is too slow ({self.queue.maxsize} records wait)")

    def close(self, timeout: float = 20.0) -> None:
        """Lets what waits be written, for at most `timeout` [s]."""
        if not self.dropped.is_set():
            with contextlib.suppress(queue.Full):
                self.queue.put(None, timeout=timeout)
                self.thread.join(timeout)
            if self.thread.is_alive():
                self._drop(f"it did not finish within {timeout:g} s")

    def _work(self, open_sink: Callable[[], Any]) -> None:
        try:
            sink = open_sink()
            while (record := self.queue.get()) is not None and not self.dropped.is_set():
                sink.log(record)
            sink.close()
        except BaseException as error:  # whatever a logger does, training goes on
            self._drop(one_line(error))

    def _drop(self, reason: str) -> None:
        if not self.dropped.is_set():
            self.dropped.set()
            self.say(f"The {self.name} logger is dropped: {reason}. Training goes on.")


class _TensorBoardSink:
    """Writes scalars for TensorBoard; what earlier lives of the run wrote is hidden."""

    def __init__(self, folder: Path) -> None:
        from tensorboardX import SummaryWriter

        self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=0)
        self.close = self.writer.close

    def log(self, record: Record) -> None:
        for name, value in record.items():
            if isinstance(value, float) and math.isfinite(value):
                self.writer.add_scalar(name, value, record["update"])


class WandbSink:
    """Sends records to Weights & Biases; a resumed run goes on under the same id."""

    def __init__(self, folder: Folder, mode: Any, project: str) -> None:
        """Begins a W&B run, or goes on with it: `mode` is online or offline."""
        import wandb

        self.run = wandb.init(
            project=project, id=folder.manifest["run_id"], resume="allow", mode=mode,
            dir=str(folder.path), name="/".join(folder.path.absolute().parts[-2:]),
            config=folder.config, settings=wandb.Settings(console="off"),
            reinit="create_new",  # several seeds in one process are several W&B runs
        )  # fmt: skip
        self.run.define_metric("update")
        self.run.define_metric("*", step_metric="update")
        self.close = self.run.finish

    def log(self, record: Record) -> None:
        """Sends a record as the step of its update, unless W&B has that step."""
        if record["update"] >= self.run.step:
            self.run.log(record, step=record["update"])


def log_video(options: RunOptions, folder: Path, video: Path) -> None:
    """Goes on with a run at W&B, and logs a video that is named after its update, and its sheet."""
    import wandb

    sink = WandbSink(read(folder), options.wandb, options.wandb_project)
    sheet, update = str(video.with_suffix(".png")), int(video.stem.partition("_")[0])
    shown = {"video": wandb.Video(str(video), format="mp4"), "contact_sheet": wandb.Image(sheet)}
    sink.run.log(shown | {"update": update}, step=max(update, sink.run.step))
    sink.close()
    say(f"W&B has it as {' and '.join(shown)}")


def check_loggers(options: RunOptions) -> None:
    """Raises UserError, with the line to paste, unless the packages of loggers are there."""
    asked = {"tensorboardX": options.tensorboard, "wandb": options.wandb != "off"}
    for package, wanted in asked.items():
        if wanted:
            check_installed(package, package.removesuffix("X"))


def open_loggers(options: RunOptions, folder: Folder, say: Say) -> list[BackgroundLogger]:
    """Starts the loggers asked for, each with all lines that metrics.jsonl has by now.

    Which of them a logger lost with an earlier life of the run, nobody knows.

    Args:
      options: the run's options.
      folder: the run, cut back to where it goes on.
      say: told of a logger that is dropped.
    """
    mode, project, found = options.wandb, options.wandb_project, dict[str, Callable[[], Any]]()
    if options.tensorboard:
        found["TensorBoard"] = lambda: _TensorBoardSink(folder.path)
    if mode != "off":
        found["W&B"] = lambda: WandbSink(folder, mode, project)
    owed = read_metrics(folder.metrics) if found else []
    opened = [BackgroundLogger(k, sink, say, MOST + len(owed)) for k, sink in found.items()]
    for logger in opened:
        for record in owed:
            logger.log(record)
    return opened
