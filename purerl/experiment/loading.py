"""Where experiments come from: a name, a path or a module, and the text that is executed."""

import ast
import contextlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import purerl
from purerl.core.errors import UserError, one_line, unknown_name
from purerl.experiment import kinds, source_hashes
from purerl.experiment.definition import Experiment
from purerl.experiment.settings_json import has_settings, to_json
from purerl.machine.files import read_bytes
from purerl.ppo.config import Config, Evaluation

OURS_BESIDE = ("envs", "experiments")  # packages of ours; without `purerl.`, a person's own
# The library's own experiments: in a clone the folder beside `purerl/`, where a link leads.
OURS = (Path(__file__).parents[1] / "experiments").resolve()
# Policies that come with the library: trimmed folders of runs, each named as it is played.
POLICIES = (Path(__file__).parents[1] / "assets" / "policies").resolve()


class Source(NamedTuple):
    """An experiment and where it came from."""

    experiment: Experiment
    name: str  # names the folder under runs/
    path: Path
    text: bytes = b""  # of the file, as it was executed


def _folders() -> list[Path]:
    """Returns where named experiments are looked for: here, then the library's own."""
    places = dict.fromkeys([(Path.cwd() / "experiments").resolve(), OURS])
    return [place for place in places if place.is_dir()]


def available() -> dict[str, Path]:
    """Returns the named experiments, name -> file; of two of one name the first folder's.

    They come in the order in which the folder's `__init__.py` mentions them, the others after.
    """
    found: dict[str, Path] = {}
    for folder in _folders():
        about = folder / "__init__.py"
        order = re.findall(r"\w+", about.read_text()) if about.exists() else []
        files = [file for file in sorted(folder.glob("[!.]*.py")) if _has_experiment(file)]
        files.sort(key=lambda file: order.index(file.stem) if file.stem in order else len(order))
        found = found | {file.stem: file for file in files if file.stem not in found}
    return found


def _has_experiment(path: Path) -> bool:
    """Tells whether a file defines an experiment, as other scripts, or an editor's link, do not."""
    with contextlib.suppress(OSError):
        return bool(re.search(rb"^experiment(: *Experiment)? = ", path.read_bytes(), re.MULTILINE))
    return False


def summary(path: Path) -> str:
    """Returns the first line of a file's docstring, without running the file."""
    with contextlib.suppress(OSError, SyntaxError, ValueError):
        return (ast.get_docstring(ast.parse(path.read_bytes())) or "").partition("\n")[0]
    return ""


def find(name: str) -> Experiment:
    """Returns an experiment by name in experiments/, path of a Python file, or dotted module.

    >>> find("cartpole_swingup").ppo.num_envs
    64
    """
    return find_source(name).experiment


def find_source(name: str) -> Source:
    """Loads an experiment by name, path or module; see `find`."""
    named = available()
    if name.endswith(".py") or "/" in name:
        if not Path(name).is_file():
            raise UserError(f"There is no experiment file {name}.")
        return load_file(Path(name))
    if name in named:
        return load_file(named[name])
    spec = None
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(name) if "." in name else None
    if spec is not None and str(spec.origin).endswith(".py"):
        return load_file(Path(str(spec.origin)))
    if Path(name).exists() or Path(f"{name}.py").is_file():
        like = f"{name}/experiment" if Path(name).is_dir() else Path(name).stem
        raise UserError(f"{name} is no Python file; an experiment is one, as {like}.py.")
    places = f" in {' or '.join(map(str, _folders()))}"
    raise UserError(unknown_name("experiment", name, named, places))


def shipped(name: str) -> Path | None:
    """Returns the folder of a policy that comes with the library; None if there is none.

    What is the user's own goes before: a folder of that name here, or an experiment.
    """
    place = {place.name: place for place in POLICIES.glob("*")}.get(name)
    if place is None or Path(name).is_dir():
        return None
    return place if available().get(name, OURS / name).parent == OURS else None


def is_shipped(folder: Path) -> bool:
    """Tells whether a run's folder is one of the library's: nothing is written into it."""
    return folder.resolve().parent == POLICIES


def load_file(
    path: Path, name: str = "", text: bytes | None = None, origin: Path | None = None
) -> Source:
    """Loads the experiment that a Python file defines as `experiment = Experiment(...)`.

    What is executed is the file's text and nothing else: Python's own loader would rather take
    compiled code that it finds in `__pycache__`.

    Args:
      path: the file.
      name: the experiment's, if that is not the file's.
      text: what the file holds, where it has been read: of a run's copy.
      origin: the file that it is a copy of. That is its `__file__`: what the experiment reads
        stands beside it.
    """
    of_run = text is not None
    text = read_bytes(path) if text is None else text
    path = path.resolve()
    place = origin or path
    module_name = _module_name(path)
    spec = importlib.util.spec_from_file_location(module_name, path)
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]  # it is a .py file
    sys.modules[module_name] = module  # dataclasses and help texts look their module up
    module.__file__ = str(place)
    with _mistakes(str(path), place, of_run):
        nodes = list(ast.walk(ast.parse(text, str(path))))
    if any(isinstance(node, ast.ImportFrom) and node.level for node in nodes):
        raise UserError(
            f"{path} imports relatively (from . import ...), and a run keeps a copy of the file "
            "that has to work alone: import by the full name."
        )
    with _mistakes(str(path), place, of_run):
        source_hashes.forget_edited(module_name)
        exec(compile(text, str(path), "exec", dont_inherit=True), module.__dict__)
        source_hashes.imported_files([module_name])  # what it has imported is what it is hashed by
    if not isinstance(found := getattr(module, "experiment", None), Experiment):
        raise UserError(f"{path} defines no `experiment = Experiment(...)` (it is {found!r}).")
    for field in ("env", "network", "ppo", "evaluation"):
        if not has_settings(value := getattr(found, field)):
            raise UserError(f"{path}: {field} is {value!r}; it must be a frozen dataclass's value.")
        to_json(value, field)  # here, or the command line would meet what it cannot hold
    if wrong := kinds.wrong_value(found):
        raise UserError(f"{path}: {wrong}")
    return Source(found, name or path.stem, path, text)


def _module_name(path: Path) -> str:
    """Returns a file's name as a module: in a package its own, so that its source counts there."""
    if OURS in path.parents:
        return ".".join(("purerl.experiments", *path.with_suffix("").relative_to(OURS).parts))
    root = path.parent
    while (root / "__init__.py").exists():
        root = root.parent
    # "" stands for the folder that Python was started in.
    if root != path.parent and root in {Path(place).absolute() for place in sys.path}:
        return ".".join(path.with_suffix("").relative_to(root).parts)
    return f"purerl_experiment_{path.stem}"


@contextlib.contextmanager
def _mistakes(file: str, place: Path, of_run: bool) -> Iterator[None]:
    """Turns an error in a person's own file into one line with the line that they need to see.

    `place` is where the file's modules stand. A file `of_run` is the copy that a run has alone.
    """
    try:
        yield
    except SyntaxError as error:
        raise UserError(f"{error.filename}, line {error.lineno}: {error.msg}") from error
    except Exception as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
        where = f", line {lines[-1]}" if lines else ""
        hint = _import_hint(error, place) if isinstance(error, ImportError) else ""
        if "from purerl" in hint and of_run:
            hint += ". The run was made by an older purerl: train it anew."
        from purerl.ppo.networks import MlpOptions, RecurrentOptions  # here, as it starts JAX

        known = (Config, Evaluation, Experiment, MlpOptions, RecurrentOptions)
        hint = hint or kinds.suggest_field(str(error), *known)
        said = re.sub(r"('purerl[.\w]*') \(.*\)$", r"\1", one_line(error))
        raise UserError(f"{file}{where}: {said}{hint}") from error


def _import_hint(error: ImportError, place: Path) -> str:
    """Returns what helps after an import that failed; `place` is the file that asked for it."""
    module = error.name or ""
    first, _, inside = module.partition(".")
    name = re.search(r"cannot import name '(\w+)'", str(error))
    beside = place.parent / first
    if first == "purerl" and inside.partition(".")[0] not in OURS_BESIDE:
        return f"; {purerl.what_to_write(name[1] if name else module.rpartition('.')[2])}"
    if name or not module:
        return ""
    if beside.is_dir() or beside.with_suffix(".py").exists():
        return f"; it stands beside the file: set PYTHONPATH={place.parent}"
    if first in OURS_BESIDE:
        return f"; write `from purerl.{module} import ...`"
    return "; install it, or correct its name"
