"""Files that are written whole or not at all, and places that are tried before the work."""

from __future__ import annotations

from pathlib import Path

from modelselect_parts.objects import check_class


def told(path: object) -> str:
    """Return a path as it stands in a message: on one line."""
    return " ".join(str(path).split())


def write_atomically(path: Path, content: bytes, *, make_folder: bool = True) -> None:
    """Write `content` to a file completely or not at all: beside it first, then moved there.

    Whatever ends the writing, Ctrl-C included, the file stays as it was, and nothing is left.
    """
    check_class("path", path, "Path")
    check_class("content", content, "bytes")
    if make_folder:
        path.parent.mkdir(parents=True, exist_ok=True)
    part = _beside(path)
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")


def check_targets(out: Path | None, path: Path | None) -> None:
    """Raise ValueError unless a folder and a file can be written (or made), leaving no trace."""
    for name, place in (("out", out), ("path", path)):
        if place is not None:
            check_class(name, place, "Path")
    if out:
        _try("--out", out / "any", f"a writable folder, found {out}")
        for taken_name in sorted(out.glob("*.*")):  # by what would be a figure or a table
            if taken_name.suffix in (".png", ".csv") and taken_name.is_dir():
                raise ValueError(f"--out: expected files, found the folder {taken_name}")
    if path:
        taken = out and path.absolute() in (out.absolute(), *out.absolute().parents)
        _try("--json", path, f"a file in a writable folder, found {path}", taken=bool(taken))


def _try(flag: str, path: Path, expected: str, *, taken: bool = False) -> None:
    """Make a file beside a path, with its folders, and take all of it away again."""
    made: list[Path] = []
    try:
        if taken or (path.exists() and not path.is_file()):
            raise IsADirectoryError("not a file, or a folder of --out")
        for folder in reversed([folder for folder in path.parents if not folder.exists()]):
            folder.mkdir()
            made.append(folder)
        _beside(path).touch()
        _beside(path).unlink()
    except (OSError, ValueError) as error:  # a name with a null byte is a ValueError
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{flag}: expected {expected}: {why}") from None
    finally:
        for folder in reversed(made):
            folder.rmdir()
