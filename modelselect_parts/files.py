"""Files that are written whole or not at all, and places that are tried before the work."""

from __future__ import annotations

import tempfile
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to a file completely or not at all: beside it first, then moved there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def check_targets(out: Path | None, path: Path | None) -> None:
    """Raise ValueError unless a folder and a file can be written (or made), leaving no trace."""
    for flag, folder in (("--out", out), ("--json", path and path.parent)):
        try:
            for place in [folder, *folder.parents] if folder else []:
                if place.exists():
                    tempfile.TemporaryFile(dir=place).close()
                    break
        except OSError as error:
            found = f"{folder}: {error.strerror}"
            raise ValueError(f"{flag}: expected a writable folder, found {found}") from None
    if path and (path == out or (path.exists() and not path.is_file())):
        raise ValueError(f"--json: expected a file, found {path}")
