"""The tables of docs/results follow from what runs left, and those that are committed from what is committed."""

import json
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import results  # noqa: E402

PAIR = {
    "points": 1234, "valid_fraction": 0.5, "valid_fraction_by_area": 0.25, "median_error_m": 0.00449,
    "common_median_error_m": 0.0041, "plain_common_median_error_m": 0.0052, "coverage_50": 0.7,
    "coverage_50_by_area": 0.6, "coverage_95": 0.96, "coverage_95_by_area": 0.9,
}  # fmt: skip
EPISODES = """episode,saccades_to_target,found,target_error_m
0,2,1,0.01
1,2,1,0.03
2,2,0,
"""
FUSION = """sensor,fusion,saccades,range_ratio_median,nees_mean,z2_median,outlier_share
log_polar,"inverse_range, a cell a point",5,1.0001,1.2638,0.5728,0.0276
uniform,printed,20,0.935,11.6,18.94,0.38
"""
HONESTY = """sensor,cells,looks,nees_mean,coverage_50,coverage_95,coverage_95_low,coverage_95_high,\
outlier_share,median_error,mean_error
sgbm,20000,5,0.8512,0.711,0.9284,0.9221,0.9333,0.0222,0.0101,0.0502
"""
ABLATION = """variant,gap_per_saccade,saccades_to_target,found,gap_change,gap_change_low,gap_change_high
as it is,0.9769,1.1,1.0,,,
printed,0.6549,41.7,0.2,-0.3220,-0.4851,-0.2143
"""
CLAIM = {
    "section": "7.2", "text": "A fovea helps", "verdict": "holds", "estimate": 8.4, "ci_low": 6.2, "ci_high": 10.1,
    "n": 20,
}  # fmt: skip


def run_of(folder, command, words, result, **tables):
    """A folder as a run leaves it."""
    for name, content in (("hydra", {"hydra": {"job": {"config_name": command}}}), ("overrides", words)):
        path = folder / ".hydra" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content))
    (folder / ("claims.json" if isinstance(result, list) else "result.json")).write_text(json.dumps(result))
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


@pytest.mark.parametrize(
    ("name", "run", "lines"),
    [
        (
            "pair",
            ("sense", ["pair=motorcycle", "matcher=sgbm", "span=shorter"], PAIR, {}),
            ["| shorter | SGBM | 1,234 | 50.0% (25.0%) | 4.5 mm | 4.1 mm, 5.2 mm | 70.0% (60.0%) | 96.0% (90.0%) |"],
        ),
        (
            "search",
            ("search", ["sensor.fov_deg=90", "picture=false"], {"phantom_share": 0.045}, {"episodes": EPISODES}),
            ["| 90°, log-polar, SGBM | 2 of 3 | 2.00 | 4.5% | 2.0 cm |"],
        ),
        (
            "fusion",
            ("memory", ["study=fusion", "scene=cans"], {}, {"fusion": FUSION}),
            [
                "| log-polar | 5 | inverse range, a cell a point | 1.00 | 1.26 | 0.573 | 2.8% |",
                "| uniform | 20 | printed | 0.935 | 11.6 | 18.9 | 38.0% |",
            ],
        ),
        (
            "widest",
            ("search", ["fidelity=geometric", "acquisition=random"], {"phantom_share": 0.0}, {"episodes": EPISODES}),
            ["| 135°, log-polar, geometric, random | 2 of 3 | 2.00 | 0.0% | 2.0 cm |"],
        ),
        (
            "honesty",
            ("memory", ["study=honesty"], {}, {"honesty": HONESTY}),
            ["| sgbm | 20,000 | 5 | 0.85 | 0.71 | 0.928 (0.922–0.933) | 2.2% | 1.0% | 5.0% |"],
        ),
        (
            "ablation",
            ("reproduce", ["ablation=true", 'overrides=["a=b"]'], [CLAIM], {"ablation": ABLATION}),
            [
                "| printed | 0.655 | -0.322 (-0.485 to -0.214) | 20% | 41.7 |",
                "| as it is | 0.977 | – | 100% | 1.1 |",
            ],
        ),
        (
            "claims",
            ("reproduce", ["profile=reduced"], [CLAIM, {**CLAIM, "verdict": "undecided", "estimate": None}], {}),
            [
                "| 7.2 | A fovea helps | holds | 8.4 (6.2 to 10.1) | 20 |",
                "| 7.2 | A fovea helps | undecided | – | 20 |",
            ],
        ),
    ],
)
def test_a_table_is_what_its_runs_left(name, run, lines, tmp_path):
    command, words, result, tables = run
    folder = run_of(tmp_path / "run", command, words, result, **tables)
    results.keep(name, [folder], "abc1234", tmp_path)
    page = f"Before.\n\n<!-- results: {name} -->\nof yesterday\n<!-- end -->\nAfter.\n"
    new = results.renewed(page, tmp_path)
    table = new.splitlines()
    for line in lines:
        assert line in table, new
    assert table[0] == "Before." and table[-1] == "After." and "yesterday" not in new
    said = " ".join(["torchfovea", command, *(word for word in words if word != "picture=false")])
    said = said.replace('overrides=["a=b"]', """'overrides=["a=b"]'""")  # a shell would take the quotes away
    (origin,) = (line for line in table if line.startswith("*`"))
    assert origin.startswith(f"*`{said}`: at abc1234 on ") and "PyTorch" in origin
    assert results.renewed(new, tmp_path) == new  # once is enough


def test_a_mean_has_an_interval_where_runs_differ():
    mean, _, interval = results.mean_with_interval([2.0, 3.0, 2.0, 4.0, 3.0, 2.0]).partition(" ")
    low, high = (float(end) for end in interval.strip("()").split("–"))
    assert mean == "2.67" and 2 <= low < 2.67 < high <= 4


def test_large_tables_and_columns_that_no_table_shows_stay_where_they_are(tmp_path):
    folder = run_of(tmp_path / "run", "search", [], {"a": 1}, episodes="seed,b\n1,2\n", saccades="a\n" + "1\n" * 20_000)
    results.keep("search", [folder], "abc1234", tmp_path)
    (kept,) = results.load("search", tmp_path)
    assert kept.tables == {"episodes": [{"seed": "1"}]} and kept.result == {"a": 1}


def test_the_pages_say_what_their_data_say():
    assert results.main(["--check"]) == 0
