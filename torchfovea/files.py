"""What a run leaves behind: every file appears whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "clear_unfinished",
    "create_json",
    "json_text",
    "replacing",
    "write_csv",
    "write_figure",
    "write_json",
    "write_result",
    "write_tensors",
]


UNFINISHED = ".unfinished-"


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside ``path``; it takes the place of ``path`` once the block ends without an error.

    Args:
        path: the file to write; its folder is made where it is missing.

    Yields:
        A path in the same folder with the same suffix (writers that go by the suffix work).

    Raises:
        OSError: if the folder cannot be written, or has no space left; it names ``path``. After any error inside the
            block ``path`` is as it was.
    """
    path = Path(path)
    with _named(path), _temporary(path) as temporary:
        yield temporary
        _open_to_others(temporary)
        os.replace(temporary, path)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A file beside a path, locked for as long as its writer lives, so that `clear_unfinished` knows what was left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        handle, name = tempfile.mkstemp(prefix=f"{UNFINISHED}{path.stem}-", suffix=path.suffix, dir=path.parent)
        if _locked(handle) and os.path.exists(name):
            break
        os.close(handle)  # somebody cleared it away before it was locked
    if fcntl is None:
        os.close(handle)  # Windows would neither rename nor remove an open file
    try:
        yield Path(name)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(name)
        if fcntl is not None:
            os.close(handle)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the file in errors of the system that do not: no space left on which device?"""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def _locked(handle: int) -> bool:
    """Whether a file is ours now; where files cannot be locked it always is."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def clear_unfinished(folder: Path) -> None:
    """Remove the temporary files that writers who were killed have left in a folder or below it."""
    for path in folder.rglob(f"{UNFINISHED}*") if fcntl is not None else ():
        with suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _open_to_others(path: Path) -> None:
    """Mkstemp makes files that only their owner can read; give the rights any new file would have here."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def _plain(value: Any) -> Any:
    """A value as JSON knows it: tensors, arrays and NumPy numbers unpacked, whatever is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write JSON whose keys keep their order (dots in them mean nothing) and whose NaN and infinities are null.

    Args:
        path: the file.
        content: mappings, sequences, strings, numbers, tensors and arrays.

    Raises:
        TypeError: for content that JSON has no form for; nothing is written then.
    """
    with replacing(path) as temporary:
        temporary.write_text(json_text(content), encoding="utf-8")


def create_json(path: str | os.PathLike[str], content: Any) -> bool:
    """Write JSON unless the file exists; of several that try at once, one does.

    Args:
        path: the file, which then appears whole.
        content: as `write_json`.

    Returns:
        Whether it was written.
    """
    path = Path(path)
    with _named(path), _temporary(path) as temporary:
        temporary.write_text(json_text(content), encoding="utf-8")
        _open_to_others(temporary)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
    return True


def json_text(content: Any) -> str:
    """What `write_json` writes."""
    return json.dumps(_plain(content), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_result(folder: str | os.PathLike[str], figures: Mapping[str, Any]) -> None:
    """Write a run's ``result.json``; call it last, since its presence says that the run is complete."""
    write_json(Path(folder) / "result.json", figures)


def write_csv(path: str | os.PathLike[str], columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table: floats in the fewest digits that read back the same; NaN, infinities and None as empty cells.

    Args:
        path: the file.
        columns: the header.
        rows: each as long as the header.

    Raises:
        ValueError: for a row of another length; nothing is written then.
    """
    with replacing(path) as temporary:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            for number, row in enumerate(rows):
                if len(row) != len(columns):
                    raise ValueError(f"row {number} of {Path(path).name} has {len(row)} cells: expected {len(columns)}")
                cells = [_plain(cell) for cell in row]
                writer.writerow(["" if cell is None else cell for cell in cells])


def write_figure(path: str | os.PathLike[str], figure: Any, **options: Any) -> None:
    """Write a matplotlib figure in the format of the path's suffix; ``options`` go to its ``savefig``.

    What users name is written as it stands: only a tick's number is a formula, whatever else has dollars in it.
    """
    for text in figure.findobj(lambda artist: hasattr(artist, "set_parse_math")):
        if "$" in text.get_text() and "mathdefault" not in text.get_text():
            text.set_parse_math(False)
    with replacing(path) as temporary:
        figure.savefig(temporary, **options)


def write_tensors(path: str | os.PathLike[str], content: Any) -> None:
    """Write what `torchfovea.untrusted.read_tensors` reads: tensors, numbers, text, and collections of them."""
    import torch

    memory = io.BytesIO()  # torch's own writer words a full disk as an error of its own, without a name
    torch.save(content, memory)
    with replacing(path) as temporary:
        temporary.write_bytes(memory.getbuffer())
