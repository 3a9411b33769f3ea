"""metrics.jsonl, which is part of the run: the same lines whether the run was resumed or not."""

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

from purerl.core.errors import RunError, UserError
from purerl.machine.files import check_object, open_log, parse, read_bytes, sync, write_file

Record = dict[str, Any]
LARGEST = 1 << 30  # [bytes]
MAX_SKIPPED_IN_A_ROW = 10  # minibatches; a run that skips so many cannot go on


def deviation(values: Any) -> float:
    """Returns the standard deviation that a sample [n] tells of, over n - 1; 0 of one value."""
    return float(values.std(ddof=min(1, len(values) - 1)))


def read_metrics(path: Path) -> list[Record]:
    """Reads whole lines of metrics.jsonl: a run that is being written may end in half a line."""
    if not os.path.lexists(path):
        return []
    texts = read_bytes(path, LARGEST).split(b"\n")[:-1]
    return [
        check_object(where := f"{path}, line {number}", parse(where, text))
        for number, text in enumerate(texts, 1)
    ]


class MetricsFile:
    """Whole lines, written at once. A resumed run first cuts the file back to its checkpoint.

    A line that the disk refuses is kept and written with the next one. So a disk that was full for
    a while leaves no gap.
    """

    def __init__(self, path: Path, offset: int, sha256: str) -> None:
        """Opens the file and forgets everything after `offset` [bytes].

        Args:
          path: the file.
          offset: how long it was when the checkpoint was taken [bytes].
          sha256: of what it held then.

        Raises:
          UserError: it does not hold that any more.
        """
        self.path = path
        self.file = open_log(path, "a+b")
        sync(path.parent)
        self.file.seek(0)
        kept = self.file.read(offset) or b""
        self.hash = hashlib.sha256(kept)
        if len(kept) < offset or self.hash.hexdigest() != sha256:
            self.file.close()
            how = f"has {len(kept)} bytes" if len(kept) < offset else "has another sha256"
            raise UserError(
                f"{path} is not what the run wrote: of the {offset} bytes that the checkpoint "
                f"counts it {how}. Bring it back from a copy, or go on with --allow-changes, which "
                "keeps its whole lines."
            )
        self.file.truncate(offset)
        os.fsync(self.file.fileno())
        self.offset = offset
        self.pending = b""

    def add(self, record: Record) -> None:
        """Takes a line, to be written next."""
        # JSON has no NaN and no infinity.
        odd = {k: None for k, v in record.items() if isinstance(v, float) and not math.isfinite(v)}
        self.pending += json.dumps(record | odd, allow_nan=False).encode() + b"\n"

    def write(self) -> None:
        """Writes what was taken. OSError: not yet, and nothing of it."""
        try:
            rest = self.pending
            while rest:  # after half of it, the rest meets the reason, such as a full disk
                written = self.file.write(rest)
                if not written:
                    raise OSError("nothing was written")
                rest = rest[written:]
        except OSError:
            self.file.truncate(self.offset)
            raise
        self.offset += len(self.pending)
        self.hash.update(self.pending)
        self.pending = b""

    def flush(self) -> Record:
        """Waits until the disk has all lines; returns what a checkpoint says of them.

        Raises:
          OSError: the disk refuses.
          RunError: the file is no longer where it was.
        """
        self.write()
        os.fsync(self.file.fileno())
        if not self.path.exists() or not os.path.samestat(
            os.fstat(self.file.fileno()), self.path.stat()
        ):
            raise RunError(
                f"{self.path} has been removed or replaced while the run wrote it. Bring it back, "
                "and go on with --resume."
            )
        return {"metrics_bytes": self.offset, "metrics_sha256": self.hash.hexdigest()}


def keep_whole_lines(path: Path, update: int) -> tuple[int, str]:
    """Rewrites a file that is not what the run wrote; returns its length [bytes] and its sha256.

    Args:
      path: the file; it may be missing.
      update: of the checkpoint. Lines after it are left out, as is what is no line of metrics.
    """
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    content = b"".join(line for line in lines if _update_of(line) <= update)
    write_file(path, content)
    return len(content), hashlib.sha256(content).hexdigest()


def _update_of(line: bytes) -> float:
    """Returns the update that a line tells of, infinity for what is no line."""
    try:
        update = json.loads(line)["update"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
    return update if line.endswith(b"\n") and isinstance(update, int) else math.inf
