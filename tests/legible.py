"""What is wrong with a picture: axes without a name or unit, writing too small to read, colours one to some eyes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

WIDTH_PX = 1200  # as wide as a picture is shown
LEAST_PX = 9.0  # height of its smallest writing there
# sequential in lightness, or diverging along an axis that red-green blindness leaves
MAPS = {"viridis", "viridis_r", "cividis", "magma", "plasma", "gray", "RdBu_r", "autumn"}
# numbers without a unit; whatever else an axis tells needs one, in square brackets
PLAIN = (
    "share", "coverage", "probability", "gap", "count", "strategy", "bias", "density", "z =", "e =", "number",
    "saccade", "fixation", "episodes", "objective", "derivative", "relative", "error against", "method",
)  # fmt: skip
# Machado, Oliveira and Fernandes (2009), whole loss of the long and of the middle cones, on linear RGB
EYES = (
    np.eye(3),
    np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
)
APART = 8.0  # of CIE 1976 colour difference


def faults(figure) -> list[str]:
    """A line for each fault of a figure that is drawn."""
    found = []
    for axes in figure.axes:
        found += [*_names(axes), *_colours(axes)]
    scale = WIDTH_PX / (72 * figure.get_figwidth())
    texts = [text for text in figure.findobj(lambda artist: hasattr(artist, "get_fontsize")) if text.get_text().strip()]
    found += _on_each_other(figure)
    small = {scale * text.get_fontsize(): text.get_text() for text in texts if text.get_visible()}
    found += [f"'{text}': {size:.1f} px high at {WIDTH_PX}" for size, text in small.items() if size < LEAST_PX]
    return found


def _on_each_other(figure) -> list[str]:
    """Titles and names of axes that are written over each other."""
    texts = [axes.title for axes in figure.axes]
    texts += [axis.label for axes in figure.axes if axes.axison for axis in axes._axis_map.values()]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text().strip()]
    pairs = combinations(boxes, 2)
    return [f"'{one}' is written over '{other}'" for (one, a), (other, b) in pairs if a.overlaps(b)]


def _names(axes: Axes) -> list[str]:
    on = getattr(axes, "_axis3don", axes.axison)  # in space an axis is switched otherwise
    if not on or not axes.get_visible():
        return []
    found = []
    bar = getattr(axes, "_colorbar", None)
    if bar is not None:
        label = axes.get_ylabel() or axes.get_xlabel() or bar.mappable.axes.get_title()
        return _unit(label, f"a colour bar of '{_title(bar.mappable.axes)}'")
    for axis in axes._axis_map.values():
        if not len(axis.get_ticklocs()):
            continue
        name = f"{axis.axis_name} of '{_title(axes)}'"
        label = axis.get_label_text()
        if not label and _borrowed(axes, axis.axis_name):
            continue
        if [tick.get_text() for tick in axis.get_ticklabels() if tick.get_text()] and not label and _worded(axis):
            continue  # what stands at the ticks are words
        found += _unit(label, name)
    return found


def _title(axes: Axes | None) -> str:
    return "" if axes is None else axes.get_title() or axes.get_ylabel() or "?"


def _borrowed(axes: Axes, name: str) -> bool:
    """Whether the axis is shared with one that has a name."""
    if name not in ("x", "y"):
        return False
    group = getattr(axes, f"get_shared_{name}_axes")().get_siblings(axes)
    return any(getattr(other, f"get_{name}label")() for other in group)


def _worded(axis) -> bool:
    texts = [tick.get_text() for tick in axis.get_ticklabels()]
    return any(any(c.isalpha() for c in text) for text in texts if not text.startswith("$"))


def _unit(label: str, where: str) -> list[str]:
    if not label:
        return [f"{where}: no name"]
    if "[" in label or any(word in label for word in PLAIN):
        return []
    return [f"{where}: '{label}' has no unit"]


def _colours(axes: Axes) -> list[str]:
    found = []
    for drawn in [*axes.images, *axes.collections]:
        if drawn.get_array() is not None and np.asarray(drawn.get_array()).ndim < 3 and drawn.cmap.name not in MAPS:
            found.append(f"'{_title(axes)}': colours of {drawn.cmap.name}")
    looks = {}
    for line in axes.get_lines():
        if line.get_label().startswith("_"):
            continue
        looks.setdefault((line.get_linestyle(), str(line.get_marker())), []).append(to_rgb(line.get_color()))
    for patch in axes.patches:
        if not patch.get_label().startswith("_"):
            looks.setdefault("patch", []).append(to_rgb(patch.get_facecolor()))
    for colours in looks.values():
        for one, other in combinations(sorted(set(colours)), 2):
            least = min(float(np.linalg.norm(_lab(eye, one) - _lab(eye, other))) for eye in EYES)
            if least < APART:
                found.append(f"'{_title(axes)}': {one} and {other} are {least:.0f} apart to some eyes")
    return found


def _lab(eye: np.ndarray, rgb: tuple[float, float, float]) -> np.ndarray:
    """CIE L*a*b* of a colour as an eye sees it."""
    value = np.asarray(rgb)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    seen = (eye @ linear).clip(0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    t = xyz / np.array([0.9505, 1.0, 1.089])
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])
