"""The example of learned glimpses runs as it stands; its networks see what they should, and errors move the gaze."""

import runpy
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("sklearn")
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "glimpses.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(EXAMPLE))


def test_a_canvas_holds_its_digit(example, generator):
    (images, names), (others, _) = example["digits"]()
    assert (
        len(images) + len(others) == 1797 and images.shape[1:] == (16, 16) and names.unique().tolist() == [*range(10)]
    )
    canvas, middle = example["canvases"](images, torch.tensor([5, 7, 5]), generator)
    assert canvas.shape == (3, 1, 64, 64)
    for image, digit, (x, y) in zip(canvas[:, 0], images[[5, 7, 5]], (middle - 7.5).long().tolist(), strict=True):
        assert torch.equal(image[y : y + 16, x : x + 16], digit)
    _, middle = example["canvases"](images, torch.tensor([1, 2]), generator, spread=0.0)
    assert (middle - 31.5).abs().max() <= 0.5


def test_the_whole_image_has_as_many_pixels_and_only_a_learned_gaze_moves(example, generator):
    (images, _), _ = example["digits"]()
    canvas, _ = example["canvases"](images, torch.arange(8), generator)
    for eye in ("learned gaze", "gaze kept in the middle", "whole image"):
        torch.manual_seed(0)
        network, seen = example["Watcher"](eye), []
        network.encoder.register_forward_hook(lambda _, given, __, seen=seen: seen.append(given[0][:, :-2]))
        scores, _ = network(canvas)
        assert [one.shape for one in seen] == 4 * [(8, 64)] and scores.shape == (4, 8, 10)
        torch.nn.functional.cross_entropy(scores[-1], torch.arange(8)).backward()
        moved = network.move[-1].bias.grad
        # nothing but the gaze leads from the last answer's error to where the first look sent the eye
        assert (moved is not None and float(moved.norm()) > 0) == (eye == "learned gaze")
        if eye == "whole image":
            coarse = torch.nn.functional.avg_pool2d(canvas, 4)[:, 0]
            assert torch.allclose(torch.cat(seen, 1).sort(1).values, coarse.flatten(1).sort(1).values, atol=1e-6)


def test_it_says_how_often_it_was_right(example, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["glimpses.py", "--steps", "2"])
    example["main"]()
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in said] == ["learned gaze", "gaze kept in the middle", "whole image"]
    assert all(line.count("%") == 4 and line.endswith("px from the digit") for line in said)
