"""What commands say on the screen: figures and tables, a line on stderr, the bar of long work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

__all__ = ["in_words", "print_figures", "progress_bar", "say", "wide_screen"]


def in_words(figure: Any) -> str:
    """A figure in four digits; a dash for what nobody knows, whole numbers as they are."""
    return "-" if figure is None else f"{figure:.4g}" if isinstance(figure, float) else str(figure)


def print_figures(figures: Mapping[str, Any]) -> None:
    """A row for each figure."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in figures.items():
        table.add_row(name, in_words(value))
    Console().print(table)


def say(line: str) -> None:
    """A line on stderr, as it stands and in one piece."""
    Console(stderr=True).print(line, highlight=False, markup=False, soft_wrap=True)


def wide_screen(width: int = 200) -> Console:
    """Where wide tables go: the terminal, or so many columns of a file."""
    console = Console()
    return console if console.is_terminal else Console(width=width)


def progress_bar() -> Progress:
    """A bar on stderr, with time spent and left; gone when the work is done, and absent where nobody watches."""
    console = Console(stderr=True)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(
        TextColumn("{task.description}"), *columns, console=console, transient=True, disable=not console.is_terminal
    )
