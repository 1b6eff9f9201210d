"""Where the configuration lies, and where a run writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

import torchfovea

__all__ = ["SweepFolder", "conf_dir", "help_text", "run_folder", "sized"]


def conf_dir() -> str:
    """The folder of the YAML files: inside an installed package, or beside the package in a checkout."""
    package = Path(torchfovea.__file__).resolve().parent
    installed = package / "conf"
    return str(installed if installed.is_dir() else package.parent / "conf")


def run_folder() -> Path:
    """The running job's own folder (Hydra made it); only inside a job."""
    return Path(HydraConfig.get().runtime.output_dir)


def sized(cfg: DictConfig, quick: dict[str, Any], full: dict[str, Any]) -> DictConfig:
    """The configuration with the profile's sizes, `quick` or `full`, where a setting is null."""
    sizes = quick if HydraConfig.get().runtime.choices.get("profile") == "quick" else full
    cfg = cfg.copy()
    for setting, value in sizes.items():
        if OmegaConf.select(cfg, setting) is None:
            OmegaConf.update(cfg, setting, value)
    return cfg


def help_text(command: str) -> str:
    """A command's groups and settings as its YAML files have them, with their comments."""
    from hydra import compose, initialize_config_dir

    folder = Path(conf_dir())
    with initialize_config_dir(str(folder), version_base="1.3"):
        choices = compose(command, return_hydra_config=True).hydra.runtime.choices
    parts = []
    for group, chosen in choices.items():
        if (folder / str(group)).is_dir():
            options = "|".join(sorted(path.stem for path in (folder / str(group)).glob("*.yaml")))
            text = _shown(folder / str(group) / f"{chosen}.yaml") if chosen else ""
            inside = "" if text.startswith("# @package _global_") else "  "
            body = "\n".join(f"{inside}{line}" for line in text.splitlines() if not line.startswith("# @package"))
            parts.append(f"# {group}={options}; now {chosen}\n" + (f"{group}:\n" if inside and text else "") + body)
    shared = [line for line in _shown(folder / "base.yaml").splitlines() if not line.startswith("#")]
    parts += ["\n".join(shared), _shown(folder / f"{command}.yaml")]
    last = "--multirun with setting=a,b,... runs every combination; --hydra-help shows what Hydra itself can do."
    return "\n\n".join([*(part.strip("\n") for part in parts if part.strip()), last])


def _shown(path: Path) -> str:
    """A YAML file without its list of defaults and Hydra's own settings."""
    lines, hidden = [], False
    for line in path.read_text(encoding="utf-8").splitlines():
        if line and not line[0].isspace():
            hidden = line.startswith(("defaults:", "hydra:"))
        if not hidden:
            lines.append(line)
    return "\n".join(lines)


class SweepFolder(Callback):
    """Hydra callback that remembers the sweep's folder, so that the command line can print it last."""

    latest: ClassVar[str | None] = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Note the folder: resolving it here also fixes its time for the whole sweep."""
        SweepFolder.latest = str(Path(config.hydra.sweep.dir).absolute())
