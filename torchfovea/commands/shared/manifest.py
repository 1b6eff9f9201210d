"""Sweeps that resume: what a folder was made with, and whether it is complete."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchfovea.files import clear_unfinished, create_json, json_text, replacing, write_json, write_result
from torchfovea.setting import SettingError, require
from torchfovea.untrusted import Damaged, path_within

__all__ = [
    "MANIFEST",
    "complete",
    "config_hash",
    "finished",
    "read_kept",
    "read_result",
    "record",
    "unchanged",
    "unclaimed",
    "withdraw",
    "write_kept",
]

MANIFEST = "manifest.json"
# what holds figures, and is read again
DATA = (".csv", ".json", ".yaml")
# settings that are told apart in one line
NAMED = 3
# what does not change a run's figures
INCIDENTAL = ("workers", "backend", "device", "batch", "picture", "trust")


def config_hash(cfg: DictConfig) -> str:
    """A hash of all settings that decide a run's figures, in any order."""
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    kept = {key: value for key, value in settings.items() if key not in INCIDENTAL}
    return hashlib.sha256(json.dumps(kept, sort_keys=True, default=str).encode()).hexdigest()[:16]


def read_result(path: Path) -> dict[str, Any]:
    """A run's result.json.

    Raises:
        SettingError: for a file that does not hold a result; it names the file.
        OSError: for one that cannot be read.
    """
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path}: {error}: expected a run's result.json; remove it to run again") from None
    if not isinstance(result, dict):
        raise SettingError(f"{path} = {type(result).__name__}: expected a run's result.json; remove it to run again")
    return result


def finished(cfg: DictConfig, folder: Path, score: str = "gap_per_saccade") -> float | None:
    """The score of a run that is already complete in its folder; else claim the folder by a manifest and return None.

    Of two runs that begin in one folder at the same moment only one makes the manifest; the other reads it.

    Raises:
        SettingError: the folder was made with other settings, or its result is corrupt; nothing is touched then.
    """
    made_with = config_hash(cfg)
    manifest, result = folder / MANIFEST, folder / "result.json"
    if not manifest.exists():
        if result.exists():
            raise SettingError(f"{result} = made without a manifest: expected another folder, or none")
        overrides = list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
        settings = OmegaConf.to_container(cfg, resolve=True)
        if create_json(manifest, {"config_hash": made_with, "overrides": overrides, "settings": settings}):
            return None
    before = _read_manifest(manifest)
    if before["config_hash"] != made_with:
        others = _others(before, cfg) or f"{before['config_hash']}, now {made_with}"
        raise SettingError(
            f"{folder} = made with other settings ({others}): expected the same settings, another folder, or none"
        )
    if not result.exists():
        clear_unfinished(folder)
        return None
    figures = read_result(result)
    value = figures.get(score)
    whole = score in figures and (value is None or isinstance(value, int | float))
    require(whole, f"{result}: {score}", value, "a number; remove the file to run again")
    unchanged(folder)
    print(f"complete since before, nothing is run again: {result}")
    return float("nan") if value is None else float(value)


def _others(before: Mapping[str, Any], cfg: DictConfig) -> str:
    """The first settings that are not those of a manifest, with both values."""
    was, now = (
        _flat(json.loads(json_text(s))) for s in (before.get("settings"), OmegaConf.to_container(cfg, resolve=True))
    )
    names = [n for n in {**was, **now} if was.get(n) != now.get(n) and n.partition(".")[0] not in INCIDENTAL]
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(f"{name} = {was.get(name)}, now {now.get(name)}" for name in names[:NAMED]) + more


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Settings by their dotted names."""
    found: dict[str, Any] = {}
    for key, value in settings.items() if isinstance(settings, dict) else ():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def complete(folder: Path, figures: Mapping[str, Any]) -> None:
    """Write result.json, which says that a run is complete; before it, what it and the data hold, into the manifest.

    A later change of a single digit is noticed by `unchanged`. Data are tables, JSON and YAML, wherever they lie in the
    folder; what is only looked at, pictures, films and logs, is anybody's to remove.
    """
    told = {key: value for key, value in _read_manifest(folder / MANIFEST).items() if key != "sha256"}
    sums = {name: _sum((folder / name).read_bytes()) for name in _data(folder)}
    sums |= {MANIFEST: _sum(json_text(told).encode()), "result.json": _sum(json_text(figures).encode())}
    write_json(folder / MANIFEST, {**told, "sha256": sums})
    write_result(folder, figures)


def unchanged(folder: Path) -> None:
    """Compare a complete run's result, data and settings with what its manifest says was written.

    Raises:
        SettingError: for the first that is another; it names the file.
    """
    told = _read_manifest(folder / MANIFEST)
    sums = told.pop("sha256", {})
    require(isinstance(sums, dict), f"{folder / MANIFEST}: sha256", sums, "the sums of files")
    for name, written in sums.items():
        try:
            path = path_within(folder, name)
        except Damaged as error:
            raise SettingError(f"{folder / MANIFEST}: {name}: expected a file of the run ({error})") from None
        content = json_text(told).encode() if name == MANIFEST else path.read_bytes() if path.is_file() else None
        state = "missing" if content is None else "changed"
        whole = content is not None and _sum(content) == written
        require(whole, str(path), state, f"what was written; remove {folder / 'result.json'} to run again")


def write_kept(path: Path, content: Any) -> None:
    """Write a part of a run's work as JSON, which `read_kept` reads when the run goes on."""
    write_json(path, {"sha256": _sum(json_text(content).encode()), "content": content})


def read_kept(path: Path) -> Any:
    """What `write_kept` wrote.

    Raises:
        SettingError: for anything else, be it another digit; it names the file.
    """
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        whole = part["sha256"] == _sum(json_text(part["content"]).encode())
    except (ValueError, KeyError, TypeError, RecursionError):
        whole = False
    if not whole:
        raise SettingError(f"{path} = corrupt: expected what was written; remove it to make it again")
    return part["content"]


def _data(folder: Path) -> list[str]:
    """The files of a run that hold figures, as paths in its folder; not what is about the run, or unfinished."""
    inside = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.suffix in DATA and path.is_file()]
    hidden = [any(part.startswith(".") for part in path.parts) for path in inside]
    return [p.as_posix() for p, h in zip(inside, hidden, strict=True) if not h and p.name != MANIFEST]


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def unclaimed(folder: Path) -> None:
    """Refuse the folder of a run that resumes, for a command that does not: its tables and result would be mixed.

    Raises:
        SettingError: for a folder with a manifest.
    """
    claimed = (folder / MANIFEST).exists()
    require(not claimed, str(folder), "the folder of a run that resumes", "another folder, or none")


def withdraw(folder: Path) -> None:
    """Take back the claim of a run that failed by a mistake in its settings before it wrote anything."""
    if all(entry.name in (MANIFEST, ".hydra") or entry.suffix == ".log" for entry in folder.iterdir()):
        (folder / MANIFEST).unlink(missing_ok=True)


def record(cfg: DictConfig, folder: Path) -> None:
    """Write what Hydra records of a job, .hydra/*.yaml: once the folder is this run's, which Hydra does not ask."""
    hydra = HydraConfig.instance().cfg
    assert hydra is not None
    parts = {"config": cfg, "hydra": hydra, "overrides": HydraConfig.get().overrides.task}
    for name, part in parts.items():
        with replacing(folder / ".hydra" / f"{name}.yaml") as temporary:
            temporary.write_text(OmegaConf.to_yaml(part), encoding="utf-8")


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        manifest["config_hash"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SettingError(f"{path}: {error}: expected a run's manifest; remove the folder to run again") from None
    return dict(manifest)
