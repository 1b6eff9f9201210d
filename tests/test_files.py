"""Files appear whole or not at all, and say nothing that JSON or a table cannot hold."""

import csv
import errno
import json
import math
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchfovea.files import (
    clear_unfinished,
    create_json,
    replacing,
    write_csv,
    write_figure,
    write_json,
    write_result,
    write_tensors,
)


def entries(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_replacing_keeps_the_suffix_and_makes_folders(tmp_path):
    target = tmp_path / "a" / "b.npz"
    with replacing(target) as temporary:
        assert temporary.suffix == ".npz"
        assert temporary.parent == target.parent
        assert not target.exists()
        temporary.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"
    assert entries(target.parent) == ["b.npz"]


def test_an_error_leaves_the_old_file_and_no_other(tmp_path):
    target = tmp_path / "b.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError, match="midway"), replacing(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError("midway")
    assert target.read_text() == "old"
    assert entries(tmp_path) == ["b.txt"]


@pytest.mark.skipif(os.name != "posix", reason="file rights are POSIX")
def test_files_get_the_rights_of_any_new_file(tmp_path):
    plain, ours = tmp_path / "plain", tmp_path / "ours.json"
    plain.touch()
    write_json(ours, {})
    assert stat.S_IMODE(ours.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_result_has_null_for_what_is_not_finite_and_keeps_order_and_dots(tmp_path):
    figures = {
        "PATH.ratio": torch.tensor(2.5, dtype=torch.float64),
        "a": math.nan,
        "found": np.float32(0.5),
        "n": np.int64(3),
        "ok": True,
        "curve": torch.tensor([1.0, math.inf, -math.inf]),
        "nested": {"x": [np.nan, 1]},
        "path": tmp_path,
    }
    write_result(tmp_path, figures)
    text = (tmp_path / "result.json").read_text()

    def forbid(name):
        raise AssertionError(name)

    read = json.loads(text, parse_constant=forbid)
    assert list(read) == list(figures)
    assert read == {
        "PATH.ratio": 2.5,
        "a": None,
        "found": 0.5,
        "n": 3,
        "ok": True,
        "curve": [1.0, None, None],
        "nested": {"x": [None, 1]},
        "path": str(tmp_path),
    }


def test_json_refuses_what_it_cannot_say_and_writes_nothing(tmp_path):
    with pytest.raises(TypeError):
        write_json(tmp_path / "x.json", {"x": object()})
    assert entries(tmp_path) == []


def test_csv_reads_back_exactly(tmp_path):
    rows = [(0, 0.1 + 0.2, "a, b"), (1, math.nan, None), (2, torch.tensor(1e-30, dtype=torch.float64), 'say "x"')]
    write_csv(tmp_path / "t.csv", ["n", "x", "text"], iter(rows))
    with (tmp_path / "t.csv").open(newline="") as file:
        read = list(csv.reader(file))
    assert read[0] == ["n", "x", "text"]
    assert [float(row[1]) for row in (read[1], read[3])] == [0.1 + 0.2, 1e-30]
    assert read[2] == ["1", "", ""]
    assert [read[1][2], read[3][2]] == ["a, b", 'say "x"']


def test_csv_of_ragged_rows_is_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"row 1 of t\.csv has 1 cells: expected 2"):
        write_csv(tmp_path / "t.csv", ["a", "b"], [(1, 2), (3,)])
    assert entries(tmp_path) == []


def test_figure_is_a_png(tmp_path):
    from matplotlib.figure import Figure

    write_figure(tmp_path / "f.png", Figure(figsize=(1, 1)), dpi=20)
    assert (tmp_path / "f.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert entries(tmp_path) == ["f.png"]


@pytest.mark.parametrize(
    "write",
    [
        lambda p: write_json(p, {"a": 1}),
        lambda p: create_json(p, {"a": 1}),
        lambda p: write_csv(p, ["a"], [(1,)]),
        lambda p: write_tensors(p, {"a": torch.zeros(3)}),
    ],
    ids=["json", "new json", "csv", "tensors"],
)
def test_no_space_left_names_the_file_and_leaves_nothing(tmp_path, monkeypatch, write):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for name in ("write_text", "write_bytes", "open"):
        monkeypatch.setattr(type(tmp_path), name, full)
    with pytest.raises(OSError, match=r"No space left on device.*it\.out"):
        write(tmp_path / "it.out")
    assert entries(tmp_path) == []


def test_what_a_killed_writer_left_is_cleared_away_and_what_one_writes_is_not(tmp_path):
    script = (
        "import sys, time; from torchfovea.files import replacing\n"
        "with replacing(sys.argv[1]) as it: it.write_text('half'); print(it, flush=True); time.sleep(600)"
    )
    started = [
        subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "x" / name)], stdout=subprocess.PIPE, text=True)
        for name in ("a.csv", "b.csv")
    ]
    try:
        dead, alive = (Path(process.stdout.readline().strip()) for process in started)
        started[0].kill()
        started[0].wait()
        (tmp_path / ".unfinished-folder").mkdir()
        clear_unfinished(tmp_path)
        assert not dead.exists() and alive.read_text() == "half"
    finally:
        for process in started:
            process.kill()
            process.communicate()


def test_names_with_dollars_are_written_as_they_stand(tmp_path):
    """Matplotlib would take them for formulas, and fail at those that are none; ticks of powers of ten are formulas."""
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    figure = Figure(figsize=(3, 2))
    axes = figure.subplots()
    axes.set(title="$a^$", xlabel="$b$ and $c_$ [m]", ylabel="d [m]", yscale="log")
    axes.plot([1, 2, 3], [1, 100, 1000], label=r"$\frac$")
    axes.set_xticks([1, 2], ["$x^$", "y"])
    axes.legend()
    write_figure(tmp_path / "f.png", figure, dpi=50)
    texts = {text.get_text(): text.get_parse_math() for text in figure.findobj(Text)}
    assert not any(parsed for text, parsed in texts.items() if "$" in text and "mathdefault" not in text)
    assert texts[r"$\mathdefault{10^{2}}$"]
