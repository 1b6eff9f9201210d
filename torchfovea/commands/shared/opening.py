"""What of a run's folder one opens first, and with what."""

from __future__ import annotations

from pathlib import Path

__all__ = ["to_open"]

SHOWN = 4  # names of one kind

KINDS = (
    ((".html",), "in a browser"),
    ((".gif", ".mp4"), "the moving picture"),
    ((".png",), "the picture"),
    ((".rrd",), "with `rerun FILE`"),
    ((".ply",), "points, in MeshLab, CloudCompare or Open3D"),
    ((".csv",), "the figures, as a table"),
)


def to_open(folder: Path) -> list[str]:
    """A line for each kind of file that the folder has, the most telling kind first."""
    lines = []
    for suffixes, hint in KINDS:
        names = sorted(path.name for path in folder.iterdir() if path.suffix in suffixes)
        if names:
            rest = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
            several = hint.replace("the picture", "the pictures") if len(names) > 1 else hint
            lines.append(f"open {', '.join(names[:SHOWN])}{rest}: {several}")
    return lines
