"""Sweeps that resume: what a folder was made with, and whether it is complete."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchfovea.files import write_json
from torchfovea.setting import SettingError

__all__ = ["MANIFEST", "config_hash", "finished", "read_result"]

MANIFEST = "manifest.json"
# what does not change a run's figures
INCIDENTAL = ("workers", "device", "batch", "picture")


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
    except ValueError as error:
        raise SettingError(f"{path}: {error}: expected a run's result.json; remove it to run again") from None
    if not isinstance(result, dict):
        raise SettingError(f"{path} = {type(result).__name__}: expected a run's result.json; remove it to run again")
    return result


def finished(cfg: DictConfig, folder: Path, score: str = "gap_per_saccade") -> float | None:
    """The score of a run that is already complete in its folder; else leave a manifest there and return None.

    Raises:
        SettingError: the folder was made with other settings, or its result is corrupt; nothing is touched then.
    """
    made_with = config_hash(cfg)
    manifest, result = folder / MANIFEST, folder / "result.json"
    if manifest.exists():
        try:
            before = json.loads(manifest.read_text(encoding="utf-8"))["config_hash"]
        except (ValueError, KeyError, TypeError) as error:
            raise SettingError(
                f"{manifest}: {error}: expected a run's manifest; remove the folder to run again"
            ) from None
        if before != made_with:
            raise SettingError(
                f"{folder} = made with other settings ({before}, now {made_with}): expected the same settings, "
                "another folder, or none"
            )
    elif result.exists():
        raise SettingError(f"{result} = made without a manifest: expected another folder, or none")
    if result.exists():
        value = read_result(result).get(score)
        return float("nan") if value is None else float(value)
    overrides = list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
    settings = OmegaConf.to_container(cfg, resolve=True)
    write_json(manifest, {"config_hash": made_with, "overrides": overrides, "settings": settings})
    return None
