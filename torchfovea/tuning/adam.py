"""Adam (Kingma and Ba 2015) as a function: PyTorch's own loads its compiler first, for a second and a half."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Averages", "adam", "at_rest"]


class Averages(NamedTuple):
    """Running means of gradients and of their squares, after so many steps."""

    first: Tensor
    second: Tensor
    step: int = 0


def at_rest(like: Tensor) -> Averages:
    """Before the first step of what has a vector's shape."""
    return Averages(torch.zeros_like(like), torch.zeros_like(like))


def adam(
    moments: Averages, gradient: Tensor, rate: float, memory: tuple[float, float] = (0.9, 0.98)
) -> tuple[Averages, Tensor]:
    """The moments after a gradient, and the step along it.

    Args:
        moments: before.
        gradient: of their shape.
        rate: size of a step.
        memory: how much of either moment stays.
    """
    (beta, gamma), step = memory, moments.step + 1
    first = beta * moments.first + (1 - beta) * gradient
    second = gamma * moments.second + (1 - gamma) * gradient.square()
    move = rate * (first / (1 - beta**step)) / ((second / (1 - gamma**step)).sqrt() + 1e-8)
    return Averages(first, second, step), move
