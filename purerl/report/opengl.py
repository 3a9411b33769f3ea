"""OpenGL without a screen. It imports no MuJoCo, which looks for a screen when it is imported."""

import ctypes.util
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from purerl.core.errors import RunError

INSTALL = (
    "Install a software renderer with `apt-get install libosmesa6`, or, on a machine with an "
    "NVIDIA GPU, the EGL part of its driver (libnvidia-gl; in a container: "
    "NVIDIA_DRIVER_CAPABILITIES=all)."
)
BACKENDS = ("egl", "osmesa")  # glfw draws only where there is a screen


def choose_gl(find: Callable[[str], str | None] = ctypes.util.find_library) -> str:
    """Chooses a backend and names it in MUJOCO_GL, where the user's own choice wins.

    Raises:
      RunError: there is no OpenGL; the message says what to install.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if not chosen:
        if Path("/dev/nvidiactl").exists() and find("EGL_nvidia"):
            chosen = "egl"
        elif find("OSMesa"):
            chosen = "osmesa"
        elif find("EGL"):  # Mesa's, which can draw on a CPU too
            chosen = "egl"
        else:
            raise RunError(f"There is no OpenGL to draw with. {INSTALL}")
    if chosen not in BACKENDS:
        raise RunError(
            f"MUJOCO_GL is {chosen!r}, with which nothing can be drawn without a screen; unset it, "
            f"or set one of {', '.join(BACKENDS)}."
        )
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = chosen
    return chosen


def open_gl(width: int, height: int) -> Any:
    """Makes an OpenGL context current for frames of up to width x height [pixels].

    Raises:
      RunError: it cannot be had; the message says what to install.
    """
    backend = choose_gl()
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # each backend has its own kinds, some without a printable message
        kind = type(error).__name__
        raise RunError(f"OpenGL does not start by {backend} ({kind}). {INSTALL}") from error
    return context
