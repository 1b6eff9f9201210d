"""Entries that are programs, in any language: how each track talks to them."""

from __future__ import annotations

import json
import select
import shlex
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.deciding.strategies import View
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations
from torchfovea.setting import SettingError, require
from torchfovea.stereo.views import Views

__all__ = ["LinePolicy", "ask_matcher", "ask_memory"]


class LinePolicy:
    """A policy that reads a line of JSON for every decision and answers with one.

    The line holds mean, std, eligible (0 or 1) and directions of the cells, incumbent, line_of_sight, last and the row
    of the batch; the answer is the number of a cell, or a list of scores.

    Args:
        command: the program with its arguments; it is started once, and ended by `close`.
        limit_s: that an answer may take.
    """

    def __init__(self, command: str, limit_s: float) -> None:
        self.limit_s, self.command, self.buffer = limit_s, command, b""
        self.process = _started(command)

    def __call__(self, view: View) -> Tensor:
        """See `torchfovea.deciding.strategies.Strategy`."""
        count = view.mean.shape[-1]
        rows = [part.reshape(-1, *part.shape[view.mean.dim() - 1 :]) for part in _parts(view)]
        scores = []
        for row, (mean, std, eligible, directions, incumbent, sight, last) in enumerate(zip(*rows, strict=True)):
            line = {
                "row": row, "mean": mean.tolist(), "std": std.tolist(), "eligible": eligible.int().tolist(),
                "directions": directions.tolist(), "incumbent": float(incumbent), "line_of_sight": sight.tolist(),
                "last": int(last),
            }  # fmt: skip
            scores.append(self._scores(self._ask(json.dumps(line)), count))
        return torch.stack(scores).reshape(view.mean.shape).to(view.mean)

    def _scores(self, answer: object, count: int) -> Tensor:
        if isinstance(answer, int) and not isinstance(answer, bool):
            require(0 <= answer < count, "command's answer", answer, f"a cell, 0 to {count - 1}")
            return torch.arange(count).eq(answer).double()
        fits = isinstance(answer, list) and len(answer) == count
        shown = len(answer) if isinstance(answer, list) else answer
        require(fits, "command's answer", shown, f"a cell or {count} scores")
        return torch.tensor(answer, dtype=torch.float64)

    def _ask(self, line: str) -> object:
        out: Any = self.process.stdout
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.flush()
        except OSError as error:
            raise SettingError(f"command = {self.command}: expected a program that reads lines ({error})") from error
        ends = time.monotonic() + self.limit_s
        while b"\n" not in self.buffer:
            left = ends - time.monotonic()
            ready = select.select([out], [], [], max(left, 0.0))[0]
            require(bool(ready), "command", f"no answer within {self.limit_s:g} s", "a line in time")
            part = out.read1(65536)
            if part == b"":
                raise SettingError(f"command = ended with status {self._end()}: expected a line for every decision")
            self.buffer += part
        answer, _, self.buffer = self.buffer.partition(b"\n")
        try:
            return json.loads(answer)
        except ValueError as error:
            raise SettingError(f"command's answer = {answer[:40]!r}: expected JSON ({error})") from error

    def _end(self) -> int:
        """How a program that has closed its output ended."""
        try:
            return self.process.wait(self.limit_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def close(self) -> None:
        """End the program."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


def _parts(view: View) -> Sequence[Tensor]:
    return (
        view.mean, view.std, view.eligible, view.directions, view.incumbent, view.line_of_sight, view.last,
    )  # fmt: skip


def _started(command: str) -> subprocess.Popen[bytes]:
    words = shlex.split(command)
    try:
        return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    except OSError as error:
        raise SettingError(f"command = {command}: expected a program ({error})") from error


def _through_files(command: str, given: dict[str, Any], wanted: dict[str, tuple[int, ...]], limit_s: float) -> Any:
    """Call a program with a folder that holds given.npz, and read what it leaves there as answer.npz."""
    with tempfile.TemporaryDirectory(prefix="torchfovea-") as name:
        folder = Path(name)
        np.savez(folder / "given.npz", **given)
        try:
            done = subprocess.run(
                [*shlex.split(command), str(folder)], capture_output=True, text=True, timeout=limit_s, check=False
            )
        except subprocess.TimeoutExpired:
            raise SettingError(f"command = no answer within {limit_s:g} s: expected one in time") from None
        except OSError as error:
            raise SettingError(f"command = {command}: expected a program ({error})") from error
        last = (done.stderr.strip().splitlines() or [""])[-1]
        require(done.returncode == 0, "command", f"ended with status {done.returncode}", f"status 0 ({last})")
        path = folder / "answer.npz"
        require(path.is_file(), "command", "no answer.npz", "that file in the folder that it is given")
        with np.load(path, allow_pickle=False) as found:
            answer = {key: torch.from_numpy(np.asarray(found[key])) for key in found.files}
    for key, shape in wanted.items():
        got = tuple(answer[key].shape) if key in answer else None
        require(got == shape, f"command's {key}", got, f"an array {shape}")
    return answer


def ask_matcher(command: str, views: Views, retina: Retina, limit_s: float) -> Correspondences:
    """A matcher by files.

    given.npz has the images left and right (H, W, 3), the receptive fields left_px (N, 2) [retinal px from the optical
    axis], R_left and R_right (3, 3) of the eyes in the rectified frame, baseline_m, and focal_px in retinal pixels.
    answer.npz has right_px (N, 2), sigma_px (N,) of either eye and valid (N,).
    """
    left_px = retina.centers_px()
    camera, rig = views.cameras(retina)[0], views.rig
    given = {
        "left": views.left.movedim(0, -1).numpy(), "right": views.right.movedim(0, -1).numpy(),
        "left_px": left_px.numpy(), "focal_px": getattr(camera, "focal_px", np.nan), "R_left": rig.R_left.numpy(),
        "R_right": rig.R_right.numpy(), "baseline_m": rig.baseline_m,
    }  # fmt: skip
    n = len(left_px)
    answer = _through_files(command, given, {"right_px": (n, 2), "sigma_px": (n,), "valid": (n,)}, limit_s)
    valid = answer["valid"].bool()
    right, sigma = answer["right_px"].to(left_px), answer["sigma_px"].to(left_px)
    good = bool(torch.isfinite(right[valid]).all()) and bool((sigma[valid] > 0).all())
    require(good, "command's answer", "NaN, or a sigma that is not positive", "finite places where valid")
    right, sigma = torch.where(valid[:, None], right, 0.0), torch.where(valid, sigma, 1.0)
    return Correspondences(left_px, right, sigma, sigma, valid)


def ask_memory(command: str, cells: Tensor, looks: Sequence[Observations], limit_s: float) -> tuple[Tensor, Tensor]:
    """A memory by files.

    given.npz has cells (Nx, 3) and of L looks of N fields mean, cov, direction, support_rad and valid, as in
    `torchfovea.sensing.triangulation.Observations`.
    answer.npz has mean (Nx,) and std (Nx,) of the inverse range along each cell [1/m];
    a std that is infinite: not known.
    """
    given = {"cells": cells.numpy()}
    for name in ("mean", "cov", "direction", "support_rad", "valid"):
        given[name] = torch.stack([getattr(look, name) for look in looks]).numpy()
    n = len(cells)
    answer = _through_files(command, given, {"mean": (n,), "std": (n,)}, limit_s)
    return answer["mean"].double(), answer["std"].double()
