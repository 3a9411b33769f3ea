"""Is an installed purerl whole, alone and gone when it is uninstalled: wheel, sdist, for editing?

python -m tests.long.wheel [--quick] [--extras brax,gymnasium]

The sdist and the wheel are built from a copy of this clone. In an empty environment each of the
three ways to install is tried: what it takes of Python's names, the commands in a folder whose
`envs/`, `experiments/`, `assets/` and `tests/` raise when they are imported, a package of another
project called `envs` installed before and after, and what is left when it is uninstalled. With the
wheel cartpole_swingup trains to a return of 930; with --quick it trains as briefly as the others.
Without --quick each extra is tried too, alone in an empty environment of its own; --extras tries
those named and nothing else.
It needs the package index, and no other network.
"""

import argparse
import email
import email.message
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
LEFT_OUT = (".git", ".venv", "__pycache__", "*_cache", ".hypothesis", "build", "dist", "site")
THEIRS = "from purerl import adapters, check_env; check_env(adapters.from_{}(adapters.{}))"
DECOYS = ("envs", "experiments", "assets", "tests")  # names that many projects have
OTHERS = (*DECOYS, "docs", "benchmarks", "peers")  # what a clone has, and nobody is to import
FEW = "--ppo.num-steps 32768 --evaluation.number 1 --evaluation.num-episodes 4"
FEW_OF_NEW = "--ppo.num-steps 8192 --evaluation.number 1 --evaluation.num-episodes 4"
ENOUGH = 930.0  # return of 1000
# What each extra is tried by: words after `purerl`, or Python.
RUN = f"run cartpole_swingup --name a {FEW}"
EXTRAS = {
    "tensorboard": [f"{RUN} --tensorboard"],
    "wandb": [f"{RUN} --wandb offline"],
    "sweep": [
        "import optuna, submitit",
        f"sweep cartpole_swingup --optuna 1 --over ppo.gamma=0.95..0.999 --seeds 1 --name a {FEW}",
    ],
    "export": [
        RUN,
        "export runs/cartpole_swingup/a --format onnx --out p.onnx",
        "export runs/cartpole_swingup/a --format jax --out p.jax",
    ],
    "clips": [
        "import numpy as np; from purerl import clips, find; "
        "model = find('cartpole_swingup').build_env().physics.model; "
        "track = np.tile(model.qpos0, (9, 1)); "
        "clips.write('a.h5', clips.pack(model, [track], ['still'], 50.0), model)",
        "clips a.h5 --body cartpole_swingup",
    ],
    "view": ["import purerl.tune.view.page, purerl.tune.view.scene"],
    "warp": ["import purerl; assert purerl.choose_engine('warp') == 'warp'"],
    "brax": [THEIRS.format("brax", "BraxOptions('inverted_pendulum')")],
    "playground": [THEIRS.format("playground", "PlaygroundOptions('CartpoleSwingup')")],
    "gymnasium": [
        THEIRS.format("gymnasium", "GymnasiumOptions('InvertedPendulum-v5')"),
        "from purerl import adapters; from purerl.envs import cartpole_swingup; "
        "adapters.gymnasium_env(cartpole_swingup.build()).reset(seed=0)",
    ],
}
OF_DEVELOPERS = {"test", "peers", "docs"}
BODIES = (
    "assets/cartpole.xml",
    *(f"experiment/templates/{x}" for x in ("body.xml", "train.sbatch")),
)
POLICIES = [x for x in (ROOT / "assets" / "policies").rglob("*") if x.is_file()]
TOP_LEVEL = """
import importlib.metadata, json, pathlib, site
(packages,) = site.getsitepackages()
names = {file.parts[0] for file in importlib.metadata.files("purerl") if file.parts[0] != ".."}
for name in [name for name in names if name.endswith(".pth")]:
    names.remove(name)
    for line in pathlib.Path(packages, name).read_text().splitlines():
        names |= {path.name for path in pathlib.Path(line).iterdir()}
print(json.dumps(sorted(name for name in names if not name.endswith(".dist-info"))))
"""


class WrongError(Exception):
    """What was wrong, in one line or with what a command said."""


class Place(NamedTuple):
    """Where everything of this check is: an environment, a clone in a folder, what was built."""

    top: Path

    @property
    def python(self) -> str:
        return str(self.top / "environment" / "bin" / "python")

    @property
    def clone(self) -> Path:
        """Called purerl, as a clone is: the folder that holds it has a folder of that name."""
        return self.top / "holds" / "purerl"

    def empty(self, name: str) -> Path:
        """Returns a folder with nothing in it."""
        folder = self.top / "folders" / name
        folder.mkdir(parents=True)
        return folder


def main(arguments: list[str]) -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("tests.long.wheel", description=__doc__, formatter_class=plain)
    parser.add_argument("--quick", action="store_true", help="train briefly")
    parser.add_argument("--extras", default="", help="try these extras alone, such as view,warp")
    chosen = parser.parse_args(arguments)
    extras = list(filter(None, chosen.extras.split(",")))
    with tempfile.TemporaryDirectory(prefix="purerl-wheel-") as folder:
        try:
            place = Place(Path(folder))
            lines = check_extras(place, extras) if extras else check(place, chosen.quick)
            for line in lines:
                print(line, flush=True)
        except WrongError as failure:
            print(f"FAILED {failure}", flush=True)
            return 1
    return 0


def check(place: Place, quick: bool) -> Iterator[str]:
    """Yields a line for each check that went well; raises WrongError at the first that did not."""
    shutil.copytree(ROOT, place.clone, symlinks=True, ignore=left_out)
    wheel, sdist = build(place)
    yield f"built: {wheel.name} ({wheel.stat().st_size:,} bytes), {sdist.name}"
    yield contents(wheel)
    toy = make_toy(place)
    call(place, place.top, sys.executable, "-m", "venv", place.top / "environment")
    constraints = ("-c", place.clone / "constraints.txt")
    pip(place, "install", *constraints, *requirements(wheel))
    yield "an empty environment with the dependencies, by constraints.txt"
    ways = {"wheel": [wheel], "sdist": [sdist], "editable": ["-e", place.clone]}
    for way, words in ways.items():
        for line in check_way(place, way, words, toy, whole=way == "wheel" and not quick):
            yield f"{way}: {line}"
    need(declared(wheel) == set(EXTRAS), f"extras are {declared(wheel)}; {set(EXTRAS)} are tried")
    for extra in [] if quick else EXTRAS:
        yield check_extra(place, wheel, extra)


def check_extras(place: Place, extras: Sequence[str]) -> Iterator[str]:
    """Builds the wheel, and tries extras; yields a line for each."""
    need(set(extras) <= set(EXTRAS), f"extras are {', '.join(EXTRAS)}")
    shutil.copytree(ROOT, place.clone, symlinks=True, ignore=left_out)
    wheel, _ = build(place)
    for extra in extras:
        yield check_extra(place, wheel, extra)


def check_extra(place: Place, wheel: Path, extra: str) -> str:
    """Installs the wheel with one extra in an empty environment, and uses what the extra is for."""
    alone = Place(place.top / f"extra-{extra}")
    alone.top.mkdir()
    call(alone, alone.top, sys.executable, "-m", "venv", alone.top / "environment")
    pip(alone, "install", "-c", place.clone / "constraints.txt", f"{wheel}[{extra}]")
    here = alone.empty("work")
    for words in EXTRAS[extra]:
        if "import " in words:
            call(alone, here, alone.python, "-c", words)
        else:
            purerl(alone, here, words)
    shutil.rmtree(alone.top)
    return f"extra {extra}: it is enough, alone in an empty environment"


def declared(wheel: Path) -> set[str]:
    """Returns the extras that a wheel declares for users."""
    return set(metadata(wheel).get_all("Provides-Extra", [])) - OF_DEVELOPERS


def check_way(place: Place, way: str, words: list, toy: Path, whole: bool) -> Iterator[str]:
    """Installs it in one way, with another project's `envs` before and after, and checks it."""
    before = installed(place)
    pip(place, "install", "--no-deps", toy)
    with_toy = installed(place)
    pip(place, "install", "--no-deps", *words)
    yield one_name(place)
    toy_works(place, place.empty(f"{way}-toy-before"))
    pip(place, "uninstall", "--yes", "toy-envs")
    yield from names_are_free(place, place.empty(f"{way}-names"))
    pip(place, "install", "--no-deps", toy)
    toy_works(place, place.empty(f"{way}-toy-after"))
    yield "another project's package `envs` works, installed before and after it"
    yield from commands(place, place.empty(f"{way}-commands"), whole)
    yield from new_project(place, place.empty(f"{way}-new"))
    if way == "editable":
        yield from beside_the_clone(place)
    pip(place, "uninstall", "--yes", "purerl")
    toy_works(place, place.empty(f"{way}-toy-alone"))
    same("uninstalling purerl", installed(place), with_toy)
    pip(place, "uninstall", "--yes", "toy-envs")
    same("uninstalling both", installed(place), before)
    yield "uninstalled: nothing is left, and the package `envs` still works"


# --- building ---


def left_out(folder: str, names: list[str]) -> set[str]:
    """Returns what a folder of the clone has and no commit has, such as the runs of its user."""
    return shutil.ignore_patterns(*LEFT_OUT, *["runs"] * (Path(folder) == ROOT))(folder, names)


def build(place: Place) -> tuple[Path, Path]:
    """Builds the sdist, and from it the wheel; returns the wheel and the sdist."""
    out = place.top / "dist"
    call(place, place.top, sys.executable, "-m", "build", "--outdir", out, place.clone)
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


def contents(wheel: Path) -> str:
    """Checks what is in the wheel and what is not."""
    names = zipfile.ZipFile(wheel).namelist()
    shipped = [str(file.relative_to(ROOT)) for file in POLICIES]
    for name in (
        "__init__.pyi",
        "py.typed",
        "envs/run.py",
        "experiments/ant_run.py",
        *BODIES,
        *shipped,
    ):
        need(f"purerl/{name}" in names, f"{wheel.name} lacks purerl/{name}")
    ours = re.compile(r"purerl(/|-[\w.]+\.dist-info/)")
    odd = [name for name in names if not ours.match(name) or re.search("benchmarks/|peers/", name)]
    need(not odd, f"{wheel.name} holds {', '.join(odd[:5])}")
    return f"{wheel.name} has {len(names)} files, all below purerl/, py.typed among them"


def requirements(wheel: Path) -> list[str]:
    """Returns what a wheel requires without any extra."""
    found = metadata(wheel).get_all("Requires-Dist", [])
    return [line for line in found if "extra ==" not in line]


def metadata(wheel: Path) -> email.message.Message:
    """Returns what a wheel says of itself."""
    archive = zipfile.ZipFile(wheel)
    (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
    return email.message_from_bytes(archive.read(name))


def make_toy(place: Place) -> Path:
    """Writes a wheel of another project, whose only package is called envs."""
    file, about = place.top / "toy_envs-1.0-py3-none-any.whl", "toy_envs-1.0.dist-info"
    texts = {
        "envs/__init__.py": 'WHOSE = "toy"\n',
        f"{about}/METADATA": "Metadata-Version: 2.1\nName: toy-envs\nVersion: 1.0\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = f"{about}/RECORD"
    texts[record] = "".join(f"{name},,\n" for name in [*texts, record])
    with zipfile.ZipFile(file, "w") as archive:
        for name, text in texts.items():
            archive.writestr(name, text)
    return file


# --- what it takes of Python's names, and leaves ---


def installed(place: Place) -> set[str]:
    """Returns the files of the environment, without compiled code."""
    top = place.top / "environment"
    return {str(p.relative_to(top)) for p in top.rglob("*") if "__pycache__" not in p.parts}


def same(what: str, now: set[str], then: set[str]) -> None:
    """Raises WrongError if an uninstallation left something, or took something of others."""
    left, taken = sorted(now - then)[:5], sorted(then - now)[:5]
    need(not left and not taken, f"{what} left {left or 'nothing'} and took {taken or 'nothing'}")


def one_name(place: Place) -> str:
    """Checks that one top-level name can be imported because of it."""
    names = json.loads(call(place, place.top, place.python, "-c", TOP_LEVEL))
    need(names == ["purerl"], f"its top-level names are {names}")
    return "its one top-level name is purerl"


def names_are_free(place: Place, here: Path) -> Iterator[str]:
    """Checks that names of the clone's folders are nobody's, or those of the user's folder."""
    for name in OTHERS:
        done = attempt(place, here, place.python, "-c", f"import {name}")
        need(
            f"No module named '{name}'" in done.stderr,
            f"`import {name}` finds a module: {done.stderr}",
        )
    (here / "envs").mkdir()
    (here / "envs" / "mine.py").write_text('WHOSE = "mine"\n')
    said = call(
        place, here, place.python, "-c", "import purerl.envs, envs.mine as m; print(m.WHOSE)"
    )
    need(said == "mine\n", f"a user's own folder envs/ is not theirs: {said}")
    yield f"{', '.join(OTHERS)} are no modules; a user's own folder envs/ is"


def toy_works(place: Place, here: Path) -> None:
    """Checks that the other project's package is what it was."""
    said = call(place, here, place.python, "-c", "import envs; print(envs.WHOSE)")
    need(said == "toy\n", f"`import envs` is not the other project's: {said}")


# --- the commands ---


def commands(place: Place, here: Path, whole: bool) -> Iterator[str]:
    """Uses the commands in a folder of decoys, as a script and as modules."""
    for name in DECOYS:
        (here / name).mkdir()
        (here / name / "__init__.py").write_text(f"raise SystemExit('the decoy {name}')\n")
    (here / "typing_extensions.py").write_text("raise SystemExit('the decoy of a dependency')\n")
    said = purerl(place, here, "run --help")
    need("cartpole_swingup" in said and "ant_run" in said, f"run --help lists: {said}")
    purerl(place, here, "check cartpole_swingup")
    said = purerl(place, here, "evaluate cartpole_swingup --episodes 4")
    need(re.search(r"episode_return +9[34]\d\.", said), f"the shipped policy reaches: {said}")
    (here / "typing_extensions.py").unlink()  # below, `-m` looks here first: Python's own rule
    said = purerl(place, here, "run cartpole_swingup --name a" + ("" if whole else f" {FEW}"))
    last = float(re.findall(r"evaluation: return (-?[\d.]+)", said)[-1])
    need(last >= ENOUGH or not whole, f"the return is {last}, not {ENOUGH}: {said}")
    purerl(place, here, "evaluate runs/cartpole_swingup/a --episodes 4")
    call(place, here, place.python, "-m", "purerl.report", "runs/cartpole_swingup")
    need(any(here.rglob("*.html")), "report wrote no page")
    yield f"beside decoys: run --help, check, run (return {last:.0f}), evaluate, report"


def new_project(place: Place, here: Path) -> Iterator[str]:
    """Writes a project of a user's own, checks it and trains it."""
    purerl(place, here, "new my_robot")
    project = here / "my_robot"
    purerl(place, project, "check experiment.py")
    purerl(place, project, f"run experiment.py --name a {FEW_OF_NEW}")
    yield "new: the project that it writes is checked and trained"


def beside_the_clone(place: Place) -> Iterator[str]:
    """Uses purerl in the folder that holds the clone, a folder called purerl."""
    here = place.clone.parent
    call(place, here, place.python, "-m", "purerl.check", "cartpole_swingup")
    purerl(place, here, "check cartpole_swingup")
    said = call(place, here, place.python, "-c", "import purerl; print(purerl.__version__)")
    yield f"in the folder that holds the clone it is found: version {said.strip()}"


# --- calling ---


def purerl(place: Place, here: Path, words: str) -> str:
    """Runs the console script; returns what it said."""
    return call(place, here, Path(place.python).with_name("purerl"), *shlex.split(words))


def pip(place: Place, verb: str, *words: object) -> None:
    call(place, place.top, place.python, "-m", "pip", verb, "--quiet", *words)


def call(place: Place, here: Path, *words: object) -> str:
    """Runs a command in a folder; returns its output; raises WrongError if it fails."""
    done = attempt(place, here, *words)
    said = f"{done.stdout[-2000:]}{done.stderr[-2000:]}"
    need(not done.returncode, f"{shlex.join(map(str, words))}: exit code {done.returncode}\n{said}")
    return done.stdout


def attempt(place: Place, here: Path, *words: object) -> subprocess.CompletedProcess:
    """Runs a command in a folder, with no path to this clone; its caches are this check's own."""
    caches = {f"XDG_{name}_HOME": str(place.top / name.lower()) for name in ("CACHE", "STATE")}
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    texts = [str(word) for word in words]
    if "pip" in texts or "build" in texts:  # theirs is the user's: it spares the downloads
        caches = {}
    return subprocess.run(texts, cwd=here, env=kept | caches, capture_output=True, text=True)


def need(holds: bool, what: str) -> None:
    """Raises WrongError unless it holds."""
    if not holds:
        raise WrongError(what)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
