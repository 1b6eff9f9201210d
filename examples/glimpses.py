"""A network that learns where to look: recurrent glimpses at cluttered digits, beside the whole image at equal pixels.

    pip install 'torchfovea[samples]'
    python examples/glimpses.py                # two minutes on two cores

A digit lies among pieces of others on a canvas of sixteen times its area. The network looks four times through a
log-polar retina of 64 receptive fields, keeps what it saw in a recurrent state, and says after each look which digit it
is and where to look next. There is no reward: the retina is differentiable in the gaze, so the classification's own
error moves the eye. In training the digits first lie in the middle and then further and further out.

The same network, so trained, sees the whole image instead: in as many pixels as its four glimpses have together, a
quarter of them (every second row and column) at each step. And it keeps its gaze in the middle.
"""

import argparse

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchfovea import LogPolar, fovea

LOOKS = 4
SIDE = 64  # of the canvas [px]
DIGIT, PIECE = 16, 6  # sides of the digit and of the pieces [px]
RETINA = LogPolar(64, rho_min_px=2.0)
SCALE = 0.45  # image pixels per retinal pixel: the retina reaches 45 px far


def canvases(digits: Tensor, which: Tensor, generator: torch.Generator, spread: float = 1.0) -> tuple[Tensor, Tensor]:
    """Images (B, 1, SIDE, SIDE) of chosen digits among pieces of others, and the digits' middles (B, 2) [px]."""
    images = torch.zeros(len(which), SIDE, SIDE)

    def put(patch: Tensor, spread: float = 1.0) -> Tensor:
        size = patch.shape[-1]
        share = 0.5 + spread * (torch.rand(2, len(which), 1, 1, generator=generator) - 0.5)
        corner = (share * (SIDE - size + 1)).long()
        rows, columns = torch.arange(size)[:, None], torch.arange(size)
        images[torch.arange(len(which))[:, None, None], corner[1] + rows, corner[0] + columns] = patch
        return corner[:, :, 0, 0].T + (size - 1) / 2

    for _ in range(6):
        other = digits[torch.randint(len(digits), (len(which),), generator=generator)]
        at = int(torch.randint(DIGIT - PIECE + 1, (), generator=generator))
        put(other[:, at : at + PIECE, at : at + PIECE])
    middle = put(digits[which], spread)
    return images[:, None], middle


class Watcher(nn.Module):
    """Encodes what it sees, remembers, and says which digit it is and where to look next."""

    def __init__(self, eye: str, width: int = 128) -> None:
        super().__init__()
        self.eye = eye
        self.encoder = nn.Sequential(nn.Linear(RETINA.count + 2, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.memory = nn.GRUCell(width, width)
        self.digit = nn.Linear(width, 10)
        self.move = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 2))
        nn.init.zeros_(self.move[-1].weight)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (LOOKS, B, 10) and gazes (LOOKS, B, 2) [px]."""
        state = image.new_zeros(len(image), self.memory.hidden_size)
        gaze = image.new_zeros(len(image), 2)  # −1 to 1 over the canvas
        whole = F.interpolate(image, (16, 16), mode="area")[:, 0]
        scores, gazes = [], []
        for k in range(LOOKS):
            gazes.append((gaze + 1) * (SIDE - 1) / 2)
            if self.eye == "whole image":
                seen = whole[:, k // 2 :: 2, k % 2 :: 2].flatten(1)
            else:
                seen = fovea(image, gazes[-1], RETINA, SCALE)[:, 0]
            state = self.memory(self.encoder(torch.cat([seen, gaze], -1)), state)
            scores.append(self.digit(state))
            if self.eye == "learned gaze":
                gaze = torch.tanh(gaze + self.move(state))
        return torch.stack(scores), torch.stack(gazes)


def digits() -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Scikit-learn's handwritten digits (N, DIGIT, DIGIT) in [0, 1] with their names, to train and to test on."""
    from sklearn.datasets import load_digits

    data = load_digits()
    images = torch.as_tensor(data.images / 16, dtype=torch.float32)[:, None]
    images, names = F.interpolate(images, (DIGIT, DIGIT), mode="bilinear")[:, 0], torch.as_tensor(data.target)
    order = torch.randperm(len(images), generator=torch.Generator().manual_seed(0))
    train, test = order[:1297], order[1297:]
    return (images[train], names[train]), (images[test], names[test])


def train(eye: str, steps: int, seed: int = 0, batch: int = 128) -> Watcher:
    """A network that sees in one way, trained on fresh canvases."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    (images, names), _ = digits()
    network = Watcher(eye)
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        which = torch.randint(len(images), (batch,), generator=generator)
        canvas, _ = canvases(images, which, generator, min(1.0, step / (0.7 * steps)))
        scores, _ = network(canvas)
        loss = F.cross_entropy(scores.flatten(0, 1), names[which].repeat(LOOKS))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def test(network: Watcher, count: int = 2000) -> tuple[Tensor, Tensor]:
    """The share of digits told right after each look, and the gaze's mean distance from them [px], (LOOKS,) each."""
    _, (images, names) = digits()
    which = torch.arange(count) % len(images)
    canvas, middle = canvases(images, which, torch.Generator().manual_seed(1000))
    scores, gazes = network(canvas)
    right = (scores.argmax(-1) == names[which]).float().mean(-1)
    return right, torch.linalg.vector_norm(gazes - middle, dim=-1).mean(-1)


def main() -> None:
    """Train and test all three."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for eye in ("learned gaze", "gaze kept in the middle", "whole image"):
        right, away = test(train(eye, given.steps, given.seed))
        told = " ".join(f"{100 * share:.0f}%" for share in right.tolist())
        print(
            f"{eye}: {told} right after each look, {', '.join(f'{px:.0f}' for px in away.tolist())} px from the digit"
        )


if __name__ == "__main__":
    main()
