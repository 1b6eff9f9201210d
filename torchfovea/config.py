"""Where the configuration lies, and where a run writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

__all__ = ["SweepFolder", "conf_dir", "run_folder"]


def conf_dir() -> str:
    """The folder of the YAML files: inside an installed package, or beside the package in a checkout."""
    installed = Path(__file__).resolve().parent / "conf"
    return str(installed if installed.is_dir() else installed.parents[1] / "conf")


def run_folder() -> Path:
    """The running job's own folder (Hydra made it); only inside a job."""
    return Path(HydraConfig.get().runtime.output_dir)


class SweepFolder(Callback):
    """Hydra callback that remembers the sweep's folder, so that the command line can print it last."""

    latest: ClassVar[str | None] = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Note the folder: resolving it here also fixes its time for the whole sweep."""
        SweepFolder.latest = str(Path(config.hydra.sweep.dir).absolute())
