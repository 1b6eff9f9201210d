"""``torchfovea COMMAND [setting=value ...]``: finds the command, runs it as a Hydra app, words the mistakes."""

from __future__ import annotations

import importlib
import io
import logging
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import torchfovea
from torchfovea.commands.table import COMMANDS, Command

__all__ = ["COMMANDS", "Command", "main"]


class JobFailed(Exception):
    """One job of a sweep failed, and that has been said."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: the command and its settings; the process's own by default.

    Returns:
        The exit status: 0, 1 for a run that failed, 2 for an unknown command, 130 after Ctrl-C.
    """
    _open_closed_streams()
    try:
        status = _dispatch(list(sys.argv[1:] if arguments is None else arguments) or ["--help"])
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has gone; leave nothing for the interpreter to flush at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _open_closed_streams() -> None:
    """Where nobody listens (``>&-``) what is said goes nowhere, rather than into whatever file is opened next."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))


def _dispatch(arguments: list[str]) -> int:
    chosen, *overrides = arguments
    if chosen in ("-h", "--help"):
        print(_help())
        return 0
    if chosen == "--version":
        print(f"torchfovea {torchfovea.__version__}")
        return 0
    if chosen not in COMMANDS:
        from torchfovea.commands.shared.mistakes import closest

        _complain("torchfovea", f"command = {chosen}: expected one of {', '.join(COMMANDS)}{closest(chosen, COMMANDS)}")
        return 2
    return _run(chosen, overrides)


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = ["torchfovea COMMAND [setting=value ...]", "", "commands:"]
    lines += [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    lines += ["", "examples:"]
    lines += [f"  {command.examples[0]}" for command in COMMANDS.values()]
    lines += [
        "",
        "torchfovea COMMAND --help has more examples and all settings; HYDRA_FULL_ERROR=1 shows whole tracebacks.",
    ]
    return "\n".join(lines)


def _complain(who: str, line: str) -> None:
    print(f"{who}: {line}", file=sys.stderr, flush=True)


@contextmanager
def _as_program(command: str, overrides: list[str]) -> Iterator[None]:
    """Let Hydra see the command's own arguments and raise its errors to us; put everything back afterwards."""
    arguments, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [f"torchfovea {command}", *overrides]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv = arguments
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error
        _close_logs()


def _close_logs() -> None:
    """Close the run's log file."""
    root = logging.getLogger()
    for handler in list(root.handlers):
        if isinstance(handler, logging.FileHandler):
            root.removeHandler(handler)
            handler.close()


def _run(command: str, overrides: list[str]) -> int:
    import hydra

    from torchfovea.allocation import keep_memory
    from torchfovea.commands.shared.config import SweepFolder, conf_dir, help_text
    from torchfovea.commands.shared.mistakes import arranged, check_folders, describe
    from torchfovea.commands.shared.trust import refuse_foreign
    from torchfovea.setting import SettingError

    try:
        overrides = arranged(overrides)
        check_folders(overrides)
    except SettingError as error:
        _complain(f"torchfovea {command}", str(error))
        return 2
    if set(overrides) & {"-h", "--help"} and not any(o.startswith(("--config", "-c")) for o in overrides):
        print(f"torchfovea {command} [setting=value ...]: {COMMANDS[command].summary}", "", sep="\n")
        print(*(f"  {example}" for example in COMMANDS[command].examples), "", sep="\n")
        print(help_text(command))
        return 0
    full_error = os.environ.get("HYDRA_FULL_ERROR") == "1"
    SweepFolder.latest = None
    keep_memory()
    status = 0
    with _as_program(command, overrides):
        app = hydra.main(version_base="1.3", config_path=conf_dir(), config_name=command)
        try:
            refuse_foreign(command, overrides)
            app(_job(command, overrides, full_error))()
        except JobFailed:
            status = 1
        except BrokenPipeError:
            raise
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except Exception as error:
            line = None if full_error else describe(error, overrides, _known_settings(command))
            if line is None:
                raise
            _complain(f"torchfovea {command}", line)
            status = 1
    if SweepFolder.latest is not None:
        print(SweepFolder.latest, flush=True)
    return status


def _known_settings(command: str) -> list[str]:
    from hydra import compose, initialize_config_dir

    from torchfovea.commands.shared.config import conf_dir
    from torchfovea.commands.shared.mistakes import setting_names

    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return setting_names(compose(config_name=command))


def _job(command: str, overrides: list[str], full_error: bool) -> Callable[[Any], Any]:
    """The function that Hydra calls, once for a run and once for each job of a sweep."""

    def job(cfg: Any) -> Any:
        from hydra.core.hydra_config import HydraConfig
        from omegaconf import OmegaConf

        from torchfovea.commands.shared.config import run_folder
        from torchfovea.commands.shared.kinds import check_groups, check_kinds
        from torchfovea.commands.shared.manifest import MANIFEST, record, unclaimed, withdraw
        from torchfovea.commands.shared.mistakes import describe, need
        from torchfovea.commands.shared.opening import to_open
        from torchfovea.commands.shared.trust import check_said

        folder = run_folder()
        settings = HydraConfig.get().job
        sweeping = not OmegaConf.is_missing(settings, "num")
        try:
            check_said(cfg)
            check_groups(command)
            check_kinds(cfg, command)
            if not COMMANDS[command].resumes:
                unclaimed(folder)
            taken = COMMANDS[command].resumes and (folder / "result.json").exists()
            if not (taken or (folder / MANIFEST).exists()):
                record(cfg, folder)
            if COMMANDS[command].draws and cfg.get("picture", True):
                need("matplotlib")
            module, _, function = COMMANDS[command].target.partition(":")
            # of a sweep's jobs only the folders are printed; each job's tables are in them
            with redirect_stdout(io.StringIO()) if sweeping else nullcontext():
                score = getattr(importlib.import_module(module), function)(cfg)
        except BrokenPipeError:
            raise
        except Exception as error:
            if full_error:
                raise
            line = describe(error, list(HydraConfig.get().overrides.task) if sweeping else overrides)
            unforeseen = line is None
            if line is None:
                traceback.print_exc()
                line = f"{type(error).__name__}: {error}"
            else:
                withdraw(folder)
            if sweeping:
                # Hydra goes on with the other jobs, and raises this at the end.
                what = settings.override_dirname
                _complain(f"torchfovea {command}: job {settings.num} ({what})", line)
                raise JobFailed(line) from None
            if not unforeseen:
                _complain(f"torchfovea {command}", line)
            _close_logs()
            _remove_bare(folder, settings.name)
            # Not an Exception, so that Hydra adds no line of its own.
            raise SystemExit(1) from None
        if sweeping:
            print(folder, flush=True)
        elif not _remove_bare(folder, settings.name):
            print(*to_open(folder), folder, sep="\n", flush=True)
        return score

    return job


def _remove_bare(folder: Path, name: str) -> bool:
    """Remove the folder of a run that wrote nothing of its own, and the folders that this leaves empty."""
    from torchfovea.commands.shared.manifest import MANIFEST

    bare = {entry.name for entry in folder.iterdir()} <= {".hydra", f"{name}.log", MANIFEST}
    if bare:
        _close_logs()
        for entry in folder.iterdir():
            shutil.rmtree(entry, ignore_errors=True) if entry.is_dir() else entry.unlink(missing_ok=True)
        with suppress(OSError):  # not empty
            if not Path.cwd().is_relative_to(folder.resolve()):  # nobody wants the ground pulled from under his feet
                folder.rmdir()
            for parent in takewhile(lambda above: above.is_relative_to(Path.cwd() / "outputs"), folder.parents):
                parent.rmdir()
    return bare
