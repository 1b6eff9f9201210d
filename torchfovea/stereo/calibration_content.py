"""What a calibration file holds, before anybody knows what it means: names with their values.

OpenCV's own files (YAML, XML, JSON) are read here and not by its FileStorage, which a damaged file can bring down.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from torchfovea.setting import SettingError, require

__all__ = ["read_content"]

MOST_BYTES = 2**20
# a deeply nested file ends the parsers' recursion
_FAILURES = (yaml.YAMLError, ElementTree.ParseError, ValueError, TypeError, KeyError, OverflowError, RecursionError)
MATRICES = ("opencv-matrix", "opencv-nd-matrix")


def read_content(path: Path) -> dict[str, Any]:
    """A file's names with their values: arrays from OpenCV's, text from plain lines, whatever YAML holds.

    Raises:
        SettingError: for a file that is missing, or holds no names.
    """
    require(path.is_file(), "calibration", path, "an existing file")
    size = path.stat().st_size
    require(size <= MOST_BYTES, f"calibration = {path}: size", f"{size} bytes", f"at most {MOST_BYTES}")
    text = path.read_bytes().decode("utf-8", "replace")
    try:
        if any(kind in text for kind in MATRICES) or "<opencv_storage" in text:
            return {name: _matrices(value) for name, value in _storage(text).items()}
        lines = [line for line in text.splitlines() if line.strip()]
        if any("=" in line and line.split("=", 1)[0].strip().isidentifier() for line in lines):
            return {k.strip(): v.strip() for k, _, v in (line.partition("=") for line in lines)}
        names = [line.partition(":")[0] for line in lines]
        if any(name in names for name in ("P0", "P1", "P2", "P_rect_00", "P_rect_01", "P_rect_02")):
            return {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
        return _named(_document(text))
    except _FAILURES as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise SettingError(f"calibration = {path}: expected a calibration file ({why})") from error


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML's plain types, with OpenCV's matrices as mappings, and without aliases, by which a file unfolds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)

    def matrix(self, node: Any) -> dict[Any, Any]:
        return {**self.construct_mapping(node, deep=True), "type_id": MATRICES[0]}


for _kind in MATRICES:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.matrix)


def _document(text: str) -> Any:
    loader = _Loader(text)
    try:
        return loader.get_data() if loader.check_data() else None
    finally:
        loader.dispose()


def _storage(text: str) -> dict[str, Any]:
    start = text.lstrip()
    if start.startswith("{"):
        return _named(json.loads(text))
    if not start.startswith("<"):
        # OpenCV's %YAML:1.0 is not YAML's own %YAML 1.0
        return _named(_document("\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))))
    if "<!" in text.replace("<!--", ""):
        raise ValueError("a document type")  # nothing that defines entities
    return {child.tag: _plain(child) for child in ElementTree.fromstring(text.strip())}


def _plain(node: ElementTree.Element) -> Any:
    """An element of OpenCV's XML as its JSON has it, numbers still as text."""
    if len(node) == 0:
        return (node.text or "").strip().strip('"')
    if all(child.tag == "_" for child in node):
        return [_plain(child) for child in node]
    return {**node.attrib, **{child.tag: _plain(child) for child in node}}


def _named(document: Any) -> dict[str, Any]:
    if not isinstance(document, Mapping):
        raise ValueError("it has no names")
    return {str(name): value for name, value in document.items()}


def _matrices(value: Any) -> Any:
    """A matrix, a number or a row of them as an array; text as it is."""
    if isinstance(value, Mapping) and value.get("type_id") in MATRICES:
        numbers = _numbers(value["data"])
        told = value["sizes"] if "sizes" in value else [value["rows"], value["cols"]]
        sizes = [int(size) for size in _numbers(told)]
        channels = numbers.size // max(math.prod(sizes), 1)
        if min(sizes) < 0 or numbers.size != math.prod(sizes) * channels:
            raise ValueError(f"{numbers.size} numbers for a matrix of {'x'.join(map(str, sizes))}")
        return numbers.reshape(sizes if channels == 1 else (*sizes, channels))
    if isinstance(value, Mapping):
        return value
    try:
        found = _numbers(value)
    except (ValueError, TypeError):
        return value
    return found if isinstance(value, list) or found.size > 1 else found.reshape(())


def _numbers(value: Any) -> np.ndarray:
    """Numbers of a list, of text between spaces, or one."""
    parts: Iterable[Any] = value.split() if isinstance(value, str) else value if isinstance(value, list) else [value]
    # OpenCV's .Nan and .Inf
    words = (part.replace(".Nan", "nan").replace(".Inf", "inf") if isinstance(part, str) else part for part in parts)
    numbers = np.array([float(word) for word in words], dtype=float)
    if numbers.size == 0 and not isinstance(value, list):
        raise ValueError("no number")
    return numbers
