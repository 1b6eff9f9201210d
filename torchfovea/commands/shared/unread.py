"""Settings of a shared group that a command does not read: refused where they are set, and not accepted in silence."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig

from torchfovea.setting import SettingError

__all__ = ["refuse_unread"]


def refuse_unread(*settings: str, only: str = "") -> None:
    """Refuse an override of what the running command does not read.

    Args:
        settings: dotted names; ``group.*`` stands for a group's choice and all of its settings.
        only: when it would read them; by default never.

    Raises:
        SettingError: for an override of one of them.
    """
    if not HydraConfig.initialized():
        return
    job = HydraConfig.get()
    for override in job.overrides.task:
        key, _, value = str(override).lstrip("+~").partition("=")
        for setting in settings:
            group = setting.removesuffix(".*")
            if key == group or (group != setting and key.startswith(f"{group}.")):
                reads = f"reads it {only} only" if only else "does not read it"
                raise SettingError(f"{key} = {value}: expected no such setting, {job.job.config_name} {reads}")
