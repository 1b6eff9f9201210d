"""The example of a live loop runs as it stands, and its robot sees what is there."""

import runpy
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "live_loop.py"


def test_the_example_searches_without_any_truth(capsys):
    left = runpy.run_path(str(EXAMPLE))
    assert len(EXAMPLE.read_text().splitlines()) <= 40
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 8 and said[0].startswith("looked at pan 0°, tilt 0°; next at")
    assert not hasattr(left["Robot"], "fixation")
    memory, points = left["glance"].step.memory, left["glance"].step.points.mean
    seen = memory.looks > 0
    assert int(seen.sum()) > 300
    truth = left["robot"].world.panorama(memory.cells.double()).range_m[seen]
    error = (points[seen].norm(dim=-1).double() / truth - 1).abs()
    assert float(error.median()) < 0.1
