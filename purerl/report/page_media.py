"""A run's videos and contact sheets, read with care and made part of a page.

A page is sent to others. So what stands in it is only what a run's folder itself holds: a link in a
stranger's folder does not put a file of the reader into it.
"""

import base64
from pathlib import Path

from purerl.core.errors import UserError
from purerl.machine.files import check_inside, read_bytes
from purerl.report.html_elements import Html, element

LARGEST = 32 << 20  # [bytes] of a file
LARGEST_PAGE = 64 << 20  # [bytes] of all files of a page
# By suffix: the kind, where its signature stands, and the signature.
KINDS = {".mp4": ("video/mp4", 4, b"ftyp"), ".png": ("image/png", 0, b"\x89PNG\r\n\x1a\n")}


def media_elements(folder: Path, room: int) -> tuple[list[Html], int]:
    """Returns a run's videos, newest first, each over its sheet; what was left out; the room left.

    Args:
      folder: the run's.
      room: how many bytes the page still takes.
    """
    files: dict[str, dict[str, bytes]] = {}  # name without suffix -> suffix -> content
    parts, left_out = list[Html](), list[Html]()
    names = (folder / "videos").glob("[!.]*.*")
    for path in sorted(names, key=lambda path: (path.stem, path.suffix), reverse=True):
        if path.suffix in KINDS:
            try:
                content = _read(folder, path, min(room, LARGEST))
            except UserError as error:
                line = str(error).replace(f"{folder}/", "")
                left_out.append(element("p", f"Left out: {line}", class_="note"))
                continue
            room -= len(content)
            files.setdefault(path.stem, {})[path.suffix] = content
    for name, kinds in files.items():
        about = f"{folder.name}, {name}"
        inside = [_element(suffix, kinds[suffix], about) for suffix in sorted(kinds)]
        caption = element("figcaption", f"{folder.name}: {name}")
        parts.append(element("figure", caption, *inside, class_="media"))
    return parts + left_out, room


def _read(folder: Path, path: Path, largest: int) -> bytes:
    """Reads a file; UserError unless it is the folder's own, not too large, and what it says."""
    check_inside(folder, path)
    content = read_bytes(path, largest)
    kind, start, signature = KINDS[path.suffix]
    if content[start : start + len(signature)] != signature:
        raise UserError(f"{path} is no {kind}: its first bytes are others.")
    return content


def _element(suffix: str, content: bytes, about: str) -> Html:
    source = f"data:{KINDS[suffix][0]};base64,{base64.b64encode(content).decode()}"
    if suffix == ".mp4":
        return element("video", src=source, controls=True, loop=True, muted=True, aria_label=about)
    return element("img", src=source, alt=f"Moments of {about}")
