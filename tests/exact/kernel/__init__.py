"""What the tests of `purerl.exact.kernel` share: kernels run by one lane, and by warps on a CPU."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from purerl.exact.kernel import compilers, launch

needs_compiler = pytest.mark.skipif(not shutil.which("g++"), reason="no g++ compiles C++ here")
WARP = Path(__file__).with_name("warp.h")


def by_one_lane(text, *arrays):
    """Runs a kernel's C++ on arrays [environments, n]."""
    return launch.on_host(compilers.on_cpu(text), text, *arrays)


def by_warps(text, *arrays, folder, environments=2, warps=1, downwards=False):
    """Runs a kernel's CUDA text, each lane of a block by itself, on arrays [environments, n]."""
    names = [f"in{i}" for i in range(len(text.inputs))]
    names += [f"out{i}" for i in range(len(text.outputs))]
    types = ["float" if kind == "f" else "int" for _, kind in (*text.inputs, *text.outputs)]
    words = ", ".join(f"{kind}* {name}" for kind, name in zip(types, names, strict=True))
    call = f"""
extern "C" bool on_lanes(const int* count, {words}) {{
  body = [=] {{ kernel(count, {", ".join(names)}); }};
  for (int block = 0; block * ENVIRONMENTS < count[0]; ++block)
    if (!run_block(block, ENVIRONMENTS, WARPS, {int(downwards)})) return false;
  return true;
}}"""
    path, library = Path(folder) / "warps.cpp", Path(folder) / f"warps{warps}{downwards}.so"
    source = compilers.source(text, compilers.Block(environments, warps))
    path.write_text(f'#include "{WARP}"\n{source}{call}')
    words = ["g++", *compilers.CPU_WORDS, str(path), "-o", str(library)]
    subprocess.run(words, check=True)

    def run(*pointers):
        assert ctypes.CDLL(str(library)).on_lanes(*pointers) & 1, "lanes wait for each other"

    return launch.on_host(run, text, *arrays)


def rows(*arrays):
    """Returns the arrays [environments, ...] that are not empty as [environments, n]."""
    return [np.reshape(x, (len(x), -1)) for x in arrays if np.size(x)]
