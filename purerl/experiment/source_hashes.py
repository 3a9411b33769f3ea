"""Hashes of the source that decides a run's bits, for the manifest.

A resume is refused for what can move a bit, and for nothing else. So code counts without its
comments, docstrings and messages, and what no traced function imports is left out, by LEFT_OUT.
"""

import ast
import contextlib
import functools
import hashlib
import importlib.util
import os
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError

PACKAGE = Path(__file__).parent.parent
# Rooms, and modules of other rooms, that no program is traced from. They prepare a run, look after
# it or look at it. The modules of rooms that compute only raise errors or word them.
LEFT_OUT = {"checks", "experiment", "machine", "report", "runs", "training", "tune"}
LEFT_OUT |= {"adapters.to_gymnasium", "core.errors", "ppo.checks"}
LEFT_OUT |= {"devices.check_sizes", "devices.memory", "devices.processes"}
# What is read from a file is data, which the manifest has by itself (`checks/held_arrays.py`).
LEFT_OUT |= {"clips.__main__", "clips.episodes", "clips.examine", "clips.files"}

# Environments and experiments count where they are imported, as a person's own do.
IMPORTED = {"envs", "experiments", "assets"}
_BY = Path(__file__).read_bytes()  # how it is hashed
_seen: dict[Path, tuple[Any, bytes]] = {}  # file -> its module's spec, and the text of both
# When this process began, by Linux [s since 1970].
_TICKS = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
_BEGIN = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + _TICKS / os.sysconf("SC_CLK_TCK")


def source_hashes(builders: Iterable[Callable], package: Path = PACKAGE) -> dict[str, str]:
    """Returns a short sha256 of each source file that may decide a run's bits, by module.

    It is of the text that this process imported, whatever the file holds now.

    The rule: every module in a room of this package counts, but for those in LEFT_OUT; the commands
    do not. So does every Python file that the builders import, installed packages excepted, with
    the bodies (`assets/*.xml`) beside it. A new module or room counts by itself.

    Args:
      builders: functions (build_env, build_network) whose imports are part of the run.
      package: the folder of this package's source.
    """
    files = package_files(package) | imported_files(map(module_of, builders))
    folders = {file.parent.parent / "assets" for file in files.values()}
    bodies = {f"assets/{f.name}": f for folder in folders for f in folder.rglob("*.xml")}
    bodies |= {str(f.relative_to(package)): f for f in package.rglob("*.h")}  # of kernels
    found = {name: known_hash(text_of(name, file)) for name, file in files.items()}
    found |= {name: hashlib.sha256(f.read_bytes()).hexdigest() for name, f in bodies.items()}
    # By name, not by place: a moved checkout is the same source.
    return {name: value[:16] for name, value in sorted(found.items())}


def known_hash(text: bytes) -> str:
    """Returns `hash_code`, kept with the compiled programs: of all files it takes 0.3 s."""
    from purerl.devices import compile_cache  # here: JAX takes seconds, and `--help` needs none

    by = (sys.version, _BY, text)  # all that it depends on
    name = hashlib.sha256(repr(by).encode()).hexdigest()
    return compile_cache.kept(name, lambda: hash_code(text).encode()).decode()


def hash_code(text: bytes) -> str:
    """Returns the sha256 of what a Python file does: comments, docstrings, messages do not count.

    >>> hash_code(b"x = 1  # one") == hash_code(b"x = 1") != hash_code(b"x = 2")
    True
    """
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError):
        return hashlib.sha256(text).hexdigest()
    parts: list[str] = []
    _say(tree, parts.append)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _say(node: ast.AST, say: Callable[[str], None]) -> None:
    """Says what a syntax tree means, part by part, without docstrings and messages of errors."""
    # Not a generator: each part would pass through one for each level of the tree.
    say(type(node).__name__)
    silent = {ast.Raise: ("exc", "cause"), ast.Assert: ("msg",)}.get(type(node), ())
    for name in node._fields:
        value = getattr(node, name, None) if name not in silent else None
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST) and not _is_text(part):
                say(f"{name}(")
                _say(part, say)
                say(")")
            elif part is not None and not isinstance(part, ast.AST):
                say(f"{name}={part!r}")


def _is_text(node: ast.AST) -> bool:
    """Tells whether a statement is a text alone: a docstring, of a module or of a field."""
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def package_files(package: Path) -> dict[str, Path]:
    """Returns module name -> file of this package, without commands and what is LEFT_OUT.

    The files are read from the folder that this very file is in. What `import purerl` finds may be
    another folder of that name, such as the one that holds the checkout.
    """
    found = {}
    for file in package.rglob("*.py"):
        room, *inside = file.relative_to(package).with_suffix("").parts
        if inside and not {room, ".".join((room, *inside))} & (LEFT_OUT | IMPORTED):
            found[".".join((package.name, room, *inside)).removesuffix(".__init__")] = file
    return found


def module_of(builder: Callable) -> str:
    """Returns the module that a function, or what wraps it as a partial, comes from."""
    while isinstance(builder, functools.partial):
        builder = builder.func
    return builder.__module__


def imported_files(names: Iterable[str]) -> dict[str, Path]:
    """Returns module name -> file, of the modules `names` and all they import.

    Other packages' files count unless they are installed: those have a version. This package's do
    not, but for those in IMPORTED: `package_files` lists them.
    """
    todo = list(names)
    ours = {_package(name): True for name in todo} | {PACKAGE.name: False, "": False}
    ours |= {f"{PACKAGE.name}.{room}": True for room in IMPORTED}
    installed = _installed_folders()
    found: dict[str, Path] = {}
    while todo:
        name = todo.pop()
        package = _package(name)
        if package not in ours:
            ours[package] = not _is_within(package, installed)
        file = module_file(name) if ours[package] and name not in found else None
        if file is not None and file.suffix == ".py":
            found[name] = file
            # Python runs a package's __init__.py first.
            todo += [*_imports(name, file), name.rpartition(".")[0]]
    return found


def _package(module: str) -> str:
    """Returns the package that a module counts with; a room in IMPORTED is one of its own."""
    first, _, inside = module.partition(".")
    room = inside.partition(".")[0]
    return f"{first}.{room}" if first == PACKAGE.name and room in IMPORTED else first


def _is_within(package: str, folders: set[Path]) -> bool:
    """Tells whether a package is in one of the folders, or nowhere."""
    file = module_file(package)
    if file is not None:
        return not folders.isdisjoint(file.parents)
    spec = importlib.util.find_spec(package) if package != "__main__" else None
    places = (spec and spec.submodule_search_locations) or []  # of a package without __init__.py
    return all(not folders.isdisjoint(Path(place).absolute().parents) for place in places)


def _installed_folders() -> set[Path]:
    """Returns where Python and installed packages are: beside a package there is its metadata."""
    places = {Path(place).absolute() for place in sys.path}
    return {*filter(_holds_packages, places), Path(sysconfig.get_path("stdlib"))}


def _holds_packages(folder: Path) -> bool:
    try:
        return any(name.endswith(".dist-info") for name in os.listdir(folder))
    except PermissionError:  # whatever is in it, it cannot be this process's own source
        return True
    except OSError:  # an archive, or nothing
        return False


def module_file(name: str) -> Path | None:
    """Returns a module's Python file; None for what is no module, such as an imported function.

    Imports nothing: `find_spec` of a dotted name would import the module before the dot, and with
    that of an engine all of MJX or Warp.
    """
    if name in sys.modules:
        spec = getattr(sys.modules[name], "__spec__", None)
        # A run's copy of an experiment says in `__file__` where the original is.
        file = spec.origin if spec and spec.has_location else None
        file = file or getattr(sys.modules[name], "__file__", None)
        return Path(file) if file else None
    package, *inside = name.split(".")
    spec = importlib.util.find_spec(package)
    if spec is None or not inside:
        return Path(spec.origin) if spec and spec.has_location and spec.origin else None
    places = [Path(place, *inside) for place in spec.submodule_search_locations or ()]
    files = [file for place in places for file in (place / "__init__.py", place.with_suffix(".py"))]
    return next((file for file in files if file.is_file()), None)


def text_of(name: str, file: Path) -> bytes:
    """Returns a module's source as this process imported it, as far as it has looked before."""
    spec = getattr(sys.modules.get(name), "__spec__", None)
    if getattr(spec, "origin", None) != str(file):  # not imported, or another file of that name
        return file.read_bytes()
    if file not in _seen or _seen[file][0] is not spec:  # a reloaded module has a new one
        _seen[file] = spec, file.read_bytes()
    return _seen[file][1]


def forget_edited(module: str) -> None:
    """Makes Python import anew what `module` imports, all of it, if some of it was edited.

    Raises:
      UserError: it is of this package, which is running.
    """
    known, ours = dict(_seen), package_files(PACKAGE)
    own = {k: x for k, x in imported_files([module]).items() if k != module}
    stale = [name for name, file in (ours | own).items() if _is_stale(name, file, known)]
    for name in stale:
        if name.startswith(f"{PACKAGE.name}."):
            raise UserError(
                f"{name} has been edited since this process imported it, so what would run is not "
                "what is there: begin a new process (in a notebook, restart the kernel)."
            )
    for file in own.values() if stale else ():
        # Python would take compiled code for that of an edit within the same second.
        Path(importlib.util.cache_from_source(str(file))).unlink(missing_ok=True)
    packages = set(map(_package, own if stale else ()))
    for name in [k for k in sys.modules if k != module and _package(k) in packages]:
        del sys.modules[name]


def _is_stale(name: str, file: Path, known: dict[Path, tuple[Any, bytes]]) -> bool:
    """Tells whether a module's file does something else by now than what was imported."""
    if file in known:
        then, now = known[file][1], file.read_bytes() if file.exists() else b""
        return then != now and hash_code(then) != hash_code(now)
    # Who imported it before may have edited it since.
    is_own = name in sys.modules and name.partition(".")[0] != PACKAGE.name
    return is_own and file.stat().st_mtime > _BEGIN


def _imports(module: str, file: Path) -> list[str]:
    """Returns every name that a module's import statements may mean as a module."""
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    names: list[str] = []
    for node in ast.walk(ast.parse(text_of(module, file), str(file))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            with contextlib.suppress(ImportError):  # `from . import x` outside of any package
                place = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                names += [place, *(f"{place}.{alias.name}" for alias in node.names)]
    return names
