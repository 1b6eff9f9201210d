"""What follows a search saccade by saccade: a page, a film and a recording for Rerun, of `search` and of `replay`."""

import re

import pytest
from PIL import Image

from torchfovea.cli import main

SMALL = ["episodes=1", "saccades=3", "sensor.receptive_fields=800", "memory.cells=200", "picture=false"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A photometric search that is filmed, drawn as a page and recorded."""
    folder = tmp_path_factory.mktemp("viewers") / "run"
    seen = ["sensor.source_px=80", "viewer=page", "video=true", "record=true", f"hydra.run.dir={folder}"]
    assert main(["search", *SMALL, *seen]) == 0
    return folder


def test_a_film_has_a_frame_a_fixation(recorded):
    with Image.open(recorded / "episode.gif") as film:
        assert film.n_frames == 3 and film.width > 600 and film.info["loop"] == 0


def test_a_page_needs_nothing_but_itself(recorded):
    page = (recorded / "episode.html").read_text()
    assert page.count("<img ") == 3 and page.count(" hidden>") == 2 and 'max="2"' in page
    assert not re.search(r"(src|href)=.(?!data:)", page)  # no request leaves it
    assert "fixation 3: the eyes meet at" in page


def test_rerun_gets_what_there_is(recorded, tmp_path):
    run = tmp_path / "again"
    replay = ["replay", f"recording={recorded / 'recording'}", "sensor.receptive_fields=800", "memory.cells=200"]
    assert main([*replay, "picture=false", "viewer=rerun", f"hydra.run.dir={run}"]) == 0
    written = (run / "replay.rrd").read_bytes()
    assert written[:4] == b"RRF2" and not list(run.glob(".replay*"))
    for entity in (
        "eyes/left/image", "eyes/right/kept", "eyes/disparity_px", "ego/sphere", "ego/points", "ego/ellipsoids",
        "ego/gaze", "ego/scan_path", "curves/information_nats",
    ):  # fmt: skip
        assert entity.encode() in written, entity


def test_without_images_the_memory_is_shown(tmp_path):
    run = tmp_path / "geometric"
    settings = ["fidelity=geometric", "episodes=3", "batch=2", "viewer=rerun", "video=true"]
    assert main(["search", *SMALL, *settings, f"hydra.run.dir={run}"]) == 0
    written = (run / "episode.rrd").read_bytes()
    assert b"ego/points" in written and b"eyes/left" not in written
    with Image.open(run / "episode.gif") as film:
        assert film.n_frames == 3


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("viewer=window", "viewer = window: expected one of page, rerun"),
        ("video=1", "video = 1: expected true or false"),
        ("workers=2", "workers = 2: expected 1 with viewer or video"),
    ],
)
def test_a_mistake_is_one_line(setting, line, tmp_path, capsys):
    shown = [] if setting.startswith("viewer") else ["viewer=page"]
    assert main(["search", *SMALL, *shown, setting, f"hydra.run.dir={tmp_path}/run"]) == 1
    printed = capsys.readouterr().err
    assert line in printed and len(printed.splitlines()) == 1
    assert not (tmp_path / "run").exists()
