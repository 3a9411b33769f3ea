"""Parts of a network that begin as another run's: read from its checkpoint, put into a first state.

No code of that run is executed: its checkpoint says which arrays it has, of which shapes.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError, unknown_name
from purerl.core.records import Array, PyTree
from purerl.experiment.definition import Part
from purerl.experiment.loading import shipped
from purerl.experiment.network_parts import belongs, is_held, map_named, top_names
from purerl.machine.state_arrays import Leaves, digest_leaves
from purerl.runs import checkpoint, checkpoint_folder, manifest
from purerl.runs.folder import check_manifest, read_run
from purerl.runs.restored_run import find_checkpoint


def read_parts(parts: Mapping[str, Part], abstract: PyTree) -> tuple[Leaves, dict[str, Any]]:
    """Returns the arrays that a new run takes over, and what its manifest says of them.

    Args:
      parts: name -> settings; those without a run are drawn, as all others.
      abstract: shapes of the new run's state.

    Raises:
      UserError: there is no such run or checkpoint, or it has not what is asked for.
    """
    leaves, facts = Leaves(), dict[str, Any]()
    for name, part in ((name, part) for name, part in parts.items() if part.run):
        try:
            found, facts[name] = _read(name, part, abstract)
        except UserError as error:
            raise UserError(f"parts.{name}.run: {error}") from error
        twice = [key for key in found if (found[key] != leaves.get(key, found[key])).any()]
        if twice:
            raise UserError(
                f"parts.{name}: its {twice[0]} is not that of a part before it: give parts that "
                "read the same entries one run, one checkpoint and one `reads`."
            )
        leaves |= found
    return leaves, facts


def _read(name: str, part: Part, abstract: PyTree) -> tuple[Leaves, dict[str, Any]]:
    """Returns one part's arrays, and the statistics that it reads by; and whose they are."""
    run = read_run(shipped(part.run) or Path(part.run))
    path, owners = find_checkpoint(run, part.checkpoint), manifest.owners(check_manifest(run))

    def asked(key: str) -> bool:
        field, _, inner = key.partition("/")
        of_part = field == "params" and belongs(inner, name)
        return of_part or (field == "normalizer" and is_held(inner, part.reads))

    try:
        stored = checkpoint_folder.load_meta(path)["leaves"]
        there = [key.removeprefix("params/") for key in stored if key.startswith("params/")]
        if not any(belongs(key, name) for key in there):
            raise UserError(unknown_name("part", name, top_names(there), f" in {run.path}"))
        array = "normalizer/mean/value" in stored and isinstance(abstract.normalizer.mean, dict)
        if array and part.reads:
            _check_cut(part.reads, abstract, stored["normalizer/mean/value"]["shape"][0])
        like = _joined(abstract, part.reads or ()) if array else abstract
        leaves, meta = checkpoint.load_leaves(path, like, owners, asked)
    except checkpoint_folder.DamagedError as error:
        raise UserError(f"The checkpoint {path} is damaged: {error}.") from error
    facts = {"run": run.manifest["run_id"], "update": meta["update"]}
    facts |= {"sha256": digest_leaves(leaves)}
    return (_cut(leaves, abstract, part.reads or ()) if array else leaves), facts


def _check_cut(reads: Sequence[str], abstract: PyTree, size: int) -> None:
    """Raises UserError unless an array of a size can be these entries, one after another."""
    sizes = {n: x.value.size for n, x in abstract.normalizer.mean.items() if x is not None}
    said = f"reads is {', '.join(reads)}"
    if "policy" in reads[1:]:
        raise UserError(f"{said}: an array begins with what the policy may read; name that first.")
    if (own := sum(sizes.get(name, 0) for name in reads)) != size:
        there = ", ".join(f"{name} ({n})" for name, n in sizes.items())
        raise UserError(
            f"{said}, {own} numbers, and the observation of that run is an array of {size}: name "
            f"the entries that it had, in their order. There are: {there}."
        )


def _joined(abstract: PyTree, reads: Iterable[str]) -> PyTree:
    """Returns the shapes of a state whose observation is an array: those entries, joined."""

    def join(entries: dict[str, Any]) -> PyTree:
        named = [entries[name] for name in reads if entries.get(name) is not None]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *named) if named else entries

    of = abstract.normalizer
    joined = [jax.eval_shape(join, of.mean), jax.eval_shape(join, of.variance)]
    return abstract.replace(normalizer=of.replace(mean=joined[0], variance=joined[1]))


def _cut(leaves: Leaves, abstract: PyTree, reads: Iterable[str]) -> Leaves:
    """Returns an array's statistics as those of the entries that were joined to it."""
    entries = abstract.normalizer.mean
    names = [name for name in reads if entries.get(name) is not None]
    ends = np.cumsum([entries[name].value.size for name in names])[:-1]
    found = Leaves()
    for key, x in leaves.items():
        field, _, inner = key.partition("/")
        of, _, which = inner.partition("/")
        pieces = zip(names, np.split(x, ends), strict=True) if field == "normalizer" else ()
        found |= {f"{field}/{of}/{name}/{which}": piece for name, piece in pieces} or {key: x}
    return found


def put_in(state: PyTree, leaves: Leaves) -> PyTree:
    """Returns a first state with `leaves` for what was drawn; of vmapped seeds for each."""

    def one(path: str, x: Array) -> Array:
        return jnp.array(np.broadcast_to(leaves[path], x.shape)) if path in leaves else x

    return map_named(one, state)
