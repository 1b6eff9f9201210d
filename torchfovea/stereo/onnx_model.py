"""A stereo network in a file, run by ONNX Runtime: two images in, a disparity and perhaps what it is worth out.

Nothing here is differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.setting import SettingError, is_number, require
from torchfovea.stereo.maps import read_values

__all__ = ["OnnxModel"]

TYPES = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64, "tensor(uint8)": np.uint8,
}  # fmt: skip


class Layout(NamedTuple):
    """How a model wants its images, and what is read of its answer.

    Attributes:
        inputs: the names of the left and the right image's input; of one that takes both, that alone.
        channels: of one image, 1 or 3.
        stacked: where one input takes both images: along its axis 0 or 1.
        size: the height and width that it was made for; None along an axis where it takes any.
        dtype: of its numbers.
        outputs: the names of the disparity and, where there is one, of what it is worth.
    """

    inputs: tuple[str, ...]
    channels: int
    stacked: int
    size: tuple[int | None, int | None]
    dtype: type
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class OnnxModel:
    """A stereo network as a function of two images; it is a `DisparityFunction`.

    An image is shrunk where it is larger than the network's size (its proportions kept), then padded on all sides with
    its border's values, to the network's size or to a multiple of `multiple`. The answer is cut out and enlarged again,
    never across a depth edge, and its pixels become the image's. Images are RGB, (peak · image − mean)/std.

    Attributes:
        model: the ONNX file.
        left: name of the left image's input, or of the one that takes both, stacked along the batch or the channels;
            null: the first.
        right: name of the right image's; null: the second.
        disparity: name of the output with the disparity, (1, 1, H, W) or without the ones, in pixels; of a flow
            (1, 2, H, W) the first component; null: the first.
        worth: name of the output that tells what the disparity is worth; null: none is read.
        tells: what that is, as `External.tells` has it.
        size_px: height and width [px] to run a network at that takes any; null: the image's.
        multiple: both are whole multiples of this, where the network takes any.
        peak: what white is.
        mean: of each channel, or of all.
        std: of each channel, or of all.
        edge_px: neighbouring disparities further apart are different surfaces, when they are enlarged [px of the
            network].
    """

    model: str | None = None
    left: str | None = None
    right: str | None = None
    disparity: str | None = None
    worth: str | None = None
    tells: str = "confidence"
    size_px: Sequence[int] | None = None
    multiple: int = 32
    peak: float = 255.0
    mean: float | Sequence[float] = 0.0
    std: float | Sequence[float] = 1.0
    edge_px: float = 1.0

    def __post_init__(self) -> None:
        """Raise SettingError for settings that do not fit the model, which is read here: before anything is seen."""
        require(self.model is not None, "matcher.model", None, "an ONNX file: matcher.model=FILE")
        for name in ("mean", "std"):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=object))
            good = values.shape in ((1,), (3,)) and all(is_number(v) for v in values)
            require(good, f"matcher.source.{name}", getattr(self, name), "a number, or three for red, green and blue")
        nonzero = all(v != 0 for v in np.atleast_1d(self.std))
        require(nonzero, "matcher.source.std", self.std, "numbers other than 0")
        require(0 < self.peak < math.inf, "matcher.source.peak", self.peak, "a positive number")
        require(self.edge_px > 0, "matcher.source.edge_px", self.edge_px, "a positive number of pixels")
        require(1 <= self.multiple <= 4096, "matcher.source.multiple", self.multiple, "1 to 4096 pixels")
        if self.size_px is not None:
            sides = np.atleast_1d(np.asarray(self.size_px, dtype=object))
            good = sides.shape == (2,) and all(isinstance(v, int) and v >= self.multiple for v in sides)
            form = f"a height and a width in whole pixels, each at least {self.multiple}"
            require(good, "matcher.source.size_px", self.size_px, form)
            good = all(v % self.multiple == 0 for v in self.size_px)
            require(
                good, "matcher.source.size_px", self.size_px, f"multiples of matcher.source.multiple = {self.multiple}"
            )
        self._layout()

    def __call__(self, left: np.ndarray, right: np.ndarray) -> Tensor | tuple[Tensor, Tensor]:
        """The disparity (H, W) [px of the images] of images (H, W, 3) in [0, 1], and what it is worth where told.

        Raises:
            SettingError: for an answer of another form, or a model that fails.
        """
        layout = self._layout()
        pair = torch.from_numpy(np.stack([left, right])).movedim(-1, 1)
        size = (int(pair.shape[-2]), int(pair.shape[-1]))
        given, inner, (top, start) = self._fitted(pair, layout)
        try:
            answers = _session(*_key(self.model)).run(layout.outputs, self._fed(given, layout))
        except Exception as error:
            raise SettingError(f"matcher.model = {self.model}: expected a model that runs ({_line(error)})") from error
        maps = []
        for name, answer in zip(layout.outputs, answers, strict=True):
            flat = np.asarray(answer, dtype=np.float32).squeeze()
            flat = flat[0] if flat.ndim == 3 and len(flat) == 2 else flat
            wanted = (given.shape[-2], given.shape[-1])
            where = f"matcher.model = {self.model}: output {name}"
            require(flat.shape == wanted, where, f"shape {np.shape(answer)}", f"(1, 1, {wanted[0]}, {wanted[1]})")
            maps.append(torch.from_numpy(flat)[top : top + inner[0], start : start + inner[1]])
        if inner != size:
            maps = self._enlarged(maps, size)
        return maps[0] if len(maps) == 1 else (maps[0], maps[1])

    def _fitted(self, pair: Tensor, layout: Layout) -> tuple[Tensor, tuple[int, int], tuple[int, int]]:
        """Images (2, 3, H, W) at the network's size, the size that they themselves have in it, and where they begin."""
        own = tuple(pair.shape[-2:])
        wanted = self.size_px or layout.size
        shrink = min([1.0, *(w / o for w, o in zip(wanted, own, strict=True) if w is not None)])
        inner = (max(1, round(own[0] * shrink)), max(1, round(own[1] * shrink)))
        if shrink < 1:
            pair = torch.nn.functional.interpolate(pair, inner, mode="bilinear", antialias=True)
        outer = [w or -(-i // self.multiple) * self.multiple for w, i in zip(wanted, inner, strict=True)]
        top, start = ((o - i) // 2 for o, i in zip(outer, inner, strict=True))
        edges = (start, outer[1] - inner[1] - start, top, outer[0] - inner[0] - top)
        return torch.nn.functional.pad(pair, edges, "replicate"), inner, (top, start)

    def _fed(self, pair: Tensor, layout: Layout) -> dict[str, np.ndarray]:
        mean, std = (torch.tensor(np.atleast_1d(v), dtype=pair.dtype)[:, None, None] for v in (self.mean, self.std))
        values = (pair * self.peak - mean) / std
        values = values.mean(1, keepdim=True) if layout.channels == 1 else values
        whole = values.round().clamp(0, 255) if layout.dtype is np.uint8 else values
        arrays = [one[None].numpy().astype(layout.dtype) for one in whole]
        if len(layout.inputs) == 1:
            return {layout.inputs[0]: np.concatenate(arrays, layout.stacked)}
        return dict(zip(layout.inputs, arrays, strict=True))

    def _enlarged(self, maps: list[Tensor], size: tuple[int, int]) -> list[Tensor]:
        """Maps of the shrunk images as maps of the images, in their pixels."""
        inner = maps[0].shape
        times = size[1] / inner[1]
        row, column = (
            ((torch.arange(one) + 0.5) * (less / one) - 0.5).clamp(0, less - 1)
            for one, less in zip(size, inner, strict=True)
        )
        place = columns(*torch.broadcast_tensors(column, row[:, None])).reshape(-1, 2)
        known = maps[0].isfinite()
        value, found = read_values(torch.where(known, maps[0], 0.0), known, place, self.edge_px)
        large = [torch.where(found, times * value, math.nan).reshape(size)]
        for worth in maps[1:]:
            near = worth[row.round().long()][:, column.round().long()]
            grown = {"sigma": near * times, "variance": near * times**2, "log_variance": near + 2 * math.log(times)}
            large.append(grown.get(self.tells, near))
        return large

    def _layout(self) -> Layout:
        """What the model wants and gives, checked.

        Raises:
            SettingError: for a file that is missing or no model, and for one with other inputs or outputs.
        """
        session = _session(*_key(self.model))
        where = f"matcher.model = {self.model}"
        inputs = {one.name: one for one in session.get_inputs()}
        told = ", ".join(f"{name} {one.type} {one.shape}" for name, one in inputs.items())
        for setting, name in (("left", self.left), ("right", self.right)):
            require(name is None or name in inputs, f"matcher.source.{setting}", name, f"an input of the model: {told}")
        require(len(inputs) in (1, 2), where, f"inputs {told}", "two images")
        left = self.left or next(name for name in inputs if name != self.right or len(inputs) == 1)
        names = [left, *([self.right] if self.right else (name for name in inputs if name != left))]
        require(len(set(names)) == len(inputs) == len(names), where, f"inputs {told}", "one an image, or one for both")
        chosen = [inputs[name] for name in names]
        # what is no number is a size that may be any
        shapes = [[side if isinstance(side, int) else None for side in one.shape] for one in chosen]
        fits = all(len(shape) == 4 for shape in shapes) and all(shape == shapes[0] for shape in shapes)
        require(fits, where, f"inputs {told}", "images (1, 3, height, width), of one size")
        batch, channels, height, width = shapes[0]
        if len(names) == 2:
            stacked, images = 0, batch in (1, None) and channels in (1, 3, None)
        else:
            stacked = 1 if channels in (2, 6) else 0
            images = channels in (2, 6) and batch in (1, None) if stacked else batch in (2, None) and channels in (1, 3)
            channels = channels // 2 if stacked and channels else channels
        form = "two images (1, 3, height, width), or both in one as (2, 3, height, width) or (1, 6, height, width)"
        require(images, where, f"inputs {told}", form)
        for one in chosen:
            require(one.type in TYPES, f"{where}: input {one.name}", one.type, "one of " + ", ".join(TYPES))
        if self.size_px is not None:
            free = all(fixed in (None, w) for fixed, w in zip((height, width), self.size_px, strict=True))
            form = f"{[height, width]}, which the model is made for"
            require(free, "matcher.source.size_px", list(self.size_px), form)
        outputs = [one.name for one in session.get_outputs()]
        for setting, name in (("disparity", self.disparity), ("worth", self.worth)):
            form = f"an output of the model: {', '.join(outputs)}"
            require(name is None or name in outputs, f"matcher.source.{setting}", name, form)
        read = (self.disparity or outputs[0], *([] if self.worth is None else [self.worth]))
        return Layout(tuple(names), channels or 3, stacked, (height, width), TYPES[chosen[0].type], read)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _key(model: str | None) -> tuple[str, float]:
    """A model's file and when it was written."""
    path = Path(str(model))
    require(path.is_file(), "matcher.model", model, "an existing ONNX file")
    return str(path), path.stat().st_mtime


@lru_cache(maxsize=4)
def _session(path: str, written: float) -> Any:
    """A model that is ready to run; read once, for reading takes long."""
    try:
        import onnxruntime
    except ImportError as error:
        raise SettingError(
            f"matcher.model = {path}: expected ONNX Runtime, which comes with pip install 'torchfovea[onnx]'"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    there = onnxruntime.get_available_providers()
    chosen = [one for one in ("CUDAExecutionProvider", "CPUExecutionProvider") if one in there]
    try:
        return onnxruntime.InferenceSession(path, options, providers=chosen)
    except Exception as error:
        raise SettingError(f"matcher.model = {path}: expected an ONNX model ({_line(error)})") from error
