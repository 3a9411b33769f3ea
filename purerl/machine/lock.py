"""One process writes a run: it holds a lock on the folder, until it ends in whatever way."""

import contextlib
import errno
import fcntl
import os
import time
from pathlib import Path

from purerl.core.errors import RunError, UserError
from purerl.machine.files import make_folder

LOCK, LOCKED = ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
PATIENCE, PAUSE = 1.0, 0.05  # seconds
# NFS locks no folder, and no read-only file; some file systems lock nothing at all.
NO_LOCKS = {errno.EBADF, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}


def _lock(handle: int, patience: float) -> None:
    """Locks a handle; BlockingIOError if another process has it for longer than `patience` s.

    Whoever asks whether a run is being trained (`sweep`) holds its lock for a moment.
    """
    for _ in range(int(patience / PAUSE)):
        with contextlib.suppress(BlockingIOError):
            return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(PAUSE)
    return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


class FolderLock:
    """A run's folder, locked for this process.

    The folder itself is locked, so that deleting a file in it changes nothing. Where the file
    system locks no folder, the file `.lock` in it is. That file says who writes.
    """

    def __init__(self, folder: Path, patience: float = PATIENCE, held: str = "") -> None:
        """Makes the folder and locks it; UserError if another process writes it, for so many s.

        `held` is how the error begins, where the folder is not a run's.
        """
        make_folder(folder)
        self.folder, self.held = folder, held
        self.handles = [os.open(folder, os.O_RDONLY | os.O_DIRECTORY)]
        try:
            self.handles.append(os.open(folder / LOCK, LOCKED, 0o644))
            self.locks = any(self._try(handle, patience) for handle in self.handles)
            os.ftruncate(self.handles[1], 0)
            os.pwrite(self.handles[1], f"{os.getpid()}\n".encode(), 0)
        except BaseException:
            self.close()
            raise

    def _try(self, handle: int, patience: float) -> bool:
        """Locks a handle; False where the file system has no such lock."""
        try:
            _lock(handle, patience)
        except BlockingIOError as error:
            owner = os.pread(self.handles[1], 20, 0).decode(errors="replace").strip() or "unknown"
            held = self.held or f"The run {self.folder} is being written by process {owner}"
            raise UserError(f"{held}; stop that one first, or use another --name.") from error
        except OSError as error:
            if error.errno in NO_LOCKS:
                return False
            raise
        return True

    def check(self) -> None:
        """Raises RunError if the folder is no longer where it was."""
        try:
            there = os.path.samestat(os.fstat(self.handles[0]), os.stat(self.folder))
        except OSError as error:  # of another kind: what is written next will tell
            there = not isinstance(error, FileNotFoundError)
        if not there:
            raise RunError(
                f"The run's folder {self.folder} has been moved or removed while it trained; "
                "nothing more can be saved there. Move it back, and go on with --resume."
            )

    def close(self) -> None:
        """Gives the lock back."""
        for handle in self.handles:
            os.close(handle)
        self.handles = []
