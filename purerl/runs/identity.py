"""Whose file it is: a run's id, and a hash of all that it is, which every checkpoint carries."""

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.runs.manifest import INFORMATIVE


class Owner(NamedTuple):
    """A run, or an earlier life of it under other conditions."""

    run_id: str
    fingerprint: str
    until: float = math.inf  # the last update that it trained


def fingerprint(config: dict[str, Any], facts: dict[str, Any], source: bytes) -> str:
    """Returns a sha256 over everything that can change a run's bits.

    Args:
      config: of config.json.
      facts: of manifest.json.
      source: of experiment.py.
    """
    relevant = {key: value for key, value in facts.items() if key not in INFORMATIVE}
    text = json.dumps([config, relevant], sort_keys=True).encode()
    return hashlib.sha256(text + b"\0" + source).hexdigest()


def owners(facts: dict[str, Any]) -> list[Owner]:
    """Returns whose checkpoints a run may hold: its own, and those from before allowed changes."""
    run_id, found = facts["run_id"], [Owner(facts["run_id"], facts["fingerprint"])]
    for change in reversed(facts.get("allowed_changes", [])):
        run_id = change.get("of", {}).get("run_id", run_id)
        found.append(Owner(run_id, change["fingerprint"], change["after_update"]))
    return found


def check_owner(path: Path, meta: dict[str, Any], owners: Sequence[Owner]) -> None:
    """Raises UserError if a checkpoint is of none of `owners` (no owners: of anybody)."""
    run: dict[str, Any] = meta["run"] if isinstance(meta.get("run"), dict) else {}
    ids = run.get("run_id"), run.get("fingerprint")
    same = [owner for owner in owners if (owner.run_id, owner.fingerprint) == ids]
    if not owners or any(meta["update"] <= owner.until for owner in same):
        return
    whose = f"of the run {ids[0]}, seed {run.get('seed')}"
    if ids[0] == owners[0].run_id:
        whose = "of this run under other settings or conditions than it has now"
    raise UserError(
        f"The checkpoint {path} is {whose}; this run is {owners[0].run_id}. It is not used: move "
        "it out of the folder."
    )
