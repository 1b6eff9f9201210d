"""The configuration of a search, composed inside another command's job, in a worker of its, or in a script."""

from __future__ import annotations

from functools import lru_cache

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchfovea.commands.shared.config import conf_dir

__all__ = ["compose_search", "config_folders"]


def config_folders() -> tuple[str, ...]:
    """The folders of configurations that a user added to the running command's, as `hydra.searchpath` takes them."""
    if not HydraConfig.initialized():
        return ()
    sources = HydraConfig.get().runtime.config_sources
    return tuple(f"{s.schema}://{s.path}" for s in sources if s.provider not in ("hydra", "main", "schema"))


@lru_cache(maxsize=64)
def compose_search(overrides: tuple[str, ...], folders: tuple[str, ...] = ()) -> DictConfig:
    """The configuration of `torchfovea search` with these settings.

    Args:
        overrides: as on its command line.
        folders: of configurations beside ours, see `config_folders`.
    """
    if GlobalHydra.instance().is_initialized():  # inside a command's own job
        return compose("search", overrides=list(overrides))
    places = [f"hydra.searchpath=[{','.join(folders)}]"] if folders else []
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("search", overrides=[*overrides, *places])
