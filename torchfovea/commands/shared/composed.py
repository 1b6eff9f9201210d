"""The configuration of a search, composed inside another command's job, in a worker of its, or in a script."""

from __future__ import annotations

from functools import lru_cache

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.kinds import check_kinds

__all__ = ["compose_search", "config_folders", "options"]


def config_folders() -> tuple[str, ...]:
    """The folders of configurations that a user added to the running command's, as `hydra.searchpath` takes them."""
    if not HydraConfig.initialized():
        return ()
    sources = HydraConfig.get().runtime.config_sources
    return tuple(f"{s.schema}://{s.path}" for s in sources if s.provider not in ("hydra", "main", "schema"))


def options(group: str) -> list[str]:
    """The choices of a group, a user's own folders' included; only inside a command's job."""
    hydra = GlobalHydra.instance().hydra
    assert hydra is not None
    return list(hydra.config_loader.get_group_options(group))


@lru_cache(maxsize=64)
def compose_search(overrides: tuple[str, ...], folders: tuple[str, ...] = ()) -> DictConfig:
    """The configuration of `torchfovea search` with these settings.

    Args:
        overrides: as on its command line.
        folders: of configurations beside ours, see `config_folders`.

    Raises:
        SettingError: for a setting of another kind than the files have.
    """
    if GlobalHydra.instance().is_initialized():  # inside a command's own job
        cfg = compose("search", overrides=list(overrides))
    else:
        places = [f"hydra.searchpath=[{','.join(folders)}]"] if folders else []
        with initialize_config_dir(conf_dir(), version_base="1.3"):
            cfg = compose("search", overrides=[*overrides, *places])
    check_kinds(cfg, "search")
    return cfg
