"""Claims judged on made-up episodes, and a whole reproduction of the smallest size."""

import json
import math
import subprocess
import sys
from dataclasses import asdict

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchfovea.cli import main
from torchfovea.commands.reproduce import cells
from torchfovea.commands.reproduce.claims import Claim, judge_claims, read_claims
from torchfovea.commands.reproduce.report import decidable, shown
from torchfovea.commands.shared.config import conf_dir
from torchfovea.setting import SettingError

SMALL = (
    "profile=quick", "episodes=2", "saccades=2", "workers=1", "memory.cells=120", "sensor.receptive_fields=300",
    "fig8.fov_deg=[135]", "fig8.alphas.few=[0,100]", "fig8.others=[pi]", "fig9.biases=[unbiased,target]",
    "fig9.alphas=[100]", "fig5.distances_m=[0.2,0.5]", "fig5.vergences=7",
)  # fmt: skip


def rows_of(values: dict[str, list[float]], metric: str = "gap_per_saccade") -> list[dict]:
    return [
        {"arm": arm, "bias": "unbiased", "seed": seed, metric: value}
        for arm, own in values.items()
        for seed, value in enumerate(own)
    ]


def claim(**changes) -> Claim:
    settings = {"id": "c", "section": "7", "text": "t", "metric": "gap_per_saccade", "plus": {"arm": "a"}}
    return Claim(**{**settings, "minus": {"arm": "b"}, **changes})


def noisy(mean: float, n: int = 20, seed: int = 0) -> list[float]:
    return (mean + 0.1 * torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).tolist()


def test_verdicts_follow_the_evidence():
    rows = rows_of({"a": noisy(0.8), "b": noisy(0.5, seed=1), "c": noisy(0.8, seed=2)})
    family = [
        claim(id="up"),
        claim(id="down", sign="less"),
        claim(id="same", minus={"arm": "c"}, sign="equal", margin=0.2),
        claim(id="unlike", sign="equal", margin=0.05),
        claim(id="close", minus={"arm": "c"}),
        claim(id="nothing", plus={"arm": "none"}),
    ]
    verdicts = judge_claims(family, rows)
    assert [v.verdict for v in verdicts] == ["holds", "fails", "holds", "fails", "undecided", "undecided"]
    up = verdicts[0]
    assert up.estimate == pytest.approx(0.3, abs=0.1) and up.ci_low < up.estimate < up.ci_high and up.n == 20
    difference = torch.tensor(noisy(0.8), dtype=torch.float64) - torch.tensor(noisy(0.5, seed=1), dtype=torch.float64)
    assert up.estimate == pytest.approx(float(difference.mean()))
    assert up.effect_size == pytest.approx(float(difference.mean() / difference.std()))
    assert up.p_holm >= up.p_value
    assert verdicts[-1].n == 0 and verdicts[-1].estimate is None


def test_scenes_are_paired_and_averaged_within():
    # two fields of view a scene; scene 2 lacks one of them and is left out
    rows = [
        {"arm": arm, "bias": "unbiased", "seed": seed, "fov_deg": fov, "gap_per_saccade": seed + 0.1 * (arm == "a")}
        for arm in "ab"
        for seed in range(3)
        for fov in (90, 135)
        if not (seed == 2 and fov == 135 and arm == "a")
    ]
    verdict = judge_claims([claim()], rows)[0]
    assert verdict.n == 2 and verdict.estimate == pytest.approx(0.1)
    assert verdict.ci_low == pytest.approx(0.1) and verdict.ci_high == pytest.approx(0.1)
    assert verdict.verdict == "undecided"  # two scenes decide nothing


def test_picks_and_thresholds():
    rows = rows_of({"a": noisy(0.7), "b": noisy(0.2, seed=1), "c": noisy(0.5, seed=2)})
    best = judge_claims([claim(minus={"arm": ["b", "c"]}, minus_pick="highest")], rows)[0]
    worst = judge_claims([claim(minus={"arm": ["b", "c"]}, minus_pick="lowest")], rows)[0]
    both = judge_claims([claim(minus={"arm": ["b", "c"]})], rows)[0]
    assert best.estimate == pytest.approx(0.2, abs=0.1) and worst.estimate == pytest.approx(0.5, abs=0.1)
    assert best.estimate < both.estimate < worst.estimate
    below = judge_claims([claim(minus=None, threshold=0.9, sign="less")], rows)[0]
    assert below.verdict == "holds" and below.estimate == pytest.approx(-0.2, abs=0.1)


def test_a_claim_about_the_best_is_as_sure_as_its_least_sure_contrast():
    """Two rivals of one mean: whoever happens to lead, picking it and testing it would favour the claim's denial."""
    rows = rows_of({"a": noisy(0.8), "b": noisy(0.5, seed=1), "c": noisy(0.72, seed=2)})
    each = [judge_claims([claim(minus={"arm": other})], rows)[0] for other in "bc"]
    both = judge_claims([claim(minus={"arm": ["b", "c"]}, minus_pick="highest")], rows)[0]
    assert both.p_value == max(one.p_value for one in each) and both.estimate == each[1].estimate
    # one rival that is better denies it, at the price of having looked at two
    rows = rows_of({"a": noisy(0.8), "b": noisy(0.5, seed=1), "c": noisy(1.1, seed=2)})
    denied = judge_claims([claim(minus={"arm": ["b", "c"]}, minus_pick="highest")], rows)[0]
    worse = judge_claims([claim(minus={"arm": "c"})], rows)[0]
    assert denied.verdict == "fails" and denied.p_value == pytest.approx(2 * worse.p_value)
    below = claim(plus={"arm": ["a", "b"]}, plus_pick="highest", minus=None, threshold=1.0, sign="less")
    assert judge_claims([below], rows)[0].verdict == "holds"


def test_every_arm_is_compared_with_itself():
    rows = [
        {"arm": arm, "bias": "unbiased", "seed": seed, "fov_deg": fov, "gap_per_saccade": value + shift * (fov == 135)}
        for arm, shift in (("a", 0.5), ("b", 0.3))
        for fov in (90, 135)
        for seed, value in enumerate(noisy(0.2, seed=fov))
    ]
    settings = {"plus": {"fov_deg": 135}, "minus": {"fov_deg": 90}, "arms": True}
    found = judge_claims([claim(**settings)], rows)[0]
    assert found.verdict == "holds" and found.n == 20
    alone = judge_claims([claim(**{**settings, "arms": False, "plus": {"fov_deg": 135, "arm": "b"},
                                   "minus": {"fov_deg": 90, "arm": "b"}})], rows)[0]  # fmt: skip
    assert found.estimate == pytest.approx(alone.estimate)


def test_a_difference_below_the_margin_does_not_count():
    rows = rows_of({"a": noisy(0.80), "b": [v - 0.02 for v in noisy(0.80)]})
    assert judge_claims([claim()], rows)[0].verdict == "holds"
    found = judge_claims([claim(margin=0.05)], rows)[0]
    assert found.verdict == "fails" and found.estimate == pytest.approx(0.02)
    assert "is greater than 0.05" in claim(margin=0.05).definition
    assert "is less than -0.05" in claim(margin=0.05, sign="less").definition


def test_what_so_many_scenes_can_decide_is_said():
    assert "no claim can be decided" in decidable(5, 21) and "no claim" not in decidable(10, 21)
    assert shown({"id": "fig5_uniform", "estimate": 0.312}) == "31%"
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("reproduce", overrides=["profile=quick"], return_hydra_config=True)
    assert cfg.profiles.quick.episodes >= 10


def test_a_missing_local_information_is_left_out():
    rows = rows_of({"a": noisy(1.0), "b": noisy(0.5)})
    rows[0]["gap_per_saccade"] = None
    assert judge_claims([claim()], rows)[0].n == 19


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sign": "bigger"}, "claims.c.sign = bigger"),
        ({"plus_pick": "best"}, "claims.c.plus_pick = best"),
        ({"sign": "equal"}, "claims.c.margin"),
        ({"arms": True, "minus_pick": "highest"}, "claims.c.arms"),
    ],
)
def test_claims_that_cannot_be_judged(changes, message):
    with pytest.raises(SettingError, match=message):
        claim(**changes)


def test_claims_are_read_by_name():
    good = {"id": "a", "section": 7, "text": "t", "metric": "found", "plus": {}}
    assert read_claims([good])[0].section == "7"
    for bad, message in (
        ([good, good], "a name that comes once"),
        ([{**good, "extra": 1}], r"claims.a.extra = 1"),
        ([{**good, "metric": None}], "no metric"),
    ):
        with pytest.raises(SettingError, match=message):
            read_claims(bad)


def test_the_claims_of_the_configuration_are_complete():
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("reproduce", return_hydra_config=True)
    claims = read_claims(OmegaConf.to_container(cfg.claims, resolve=True))
    assert len(claims) >= 20
    arms = {f"ucb_{a:g}" for a in cfg.fig8.alphas.all} | set(cfg.fig8.others)
    for one in claims:
        assert one.metric in cells.METRICS and one.definition
        for chosen in (one.plus, one.minus or {}):
            assert set(chosen.get("arm", [])) <= arms
    assert {one.section for one in claims} == {"7.2.2", "7.2.3"}


def test_regret_convergence():
    flat = torch.ones(50)
    assert cells.regret_convergence(flat) == 1
    settled = torch.cat([torch.linspace(1, 0, 11), torch.zeros(39)])
    assert cells.regret_convergence(settled) == 11
    assert cells.regret_convergence(torch.linspace(1, 0, 50)) > 45


def test_a_whole_reproduction_resumes_and_names_what_is_corrupt(tmp_path, capsys):
    folder = tmp_path / "run"
    command = ["reproduce", *SMALL, f"hydra.run.dir={folder}"]
    assert main(command) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(folder)
    result = json.loads((folder / "result.json").read_text())
    stated = json.loads((folder / "claims.json").read_text())
    assert result["claims"] == len(stated)
    assert result["claims"] == result["claims_hold"] + result["claims_fail"] + result["claims_undecided"]
    for entry in stated:
        assert {"id", "section", "text", "definition", "verdict", "estimate", "ci_low", "ci_high", "n"} <= entry.keys()
        assert entry["verdict"] in ("holds", "fails", "undecided")
    report = (folder / "report.html").read_text()
    assert all(entry["id"] in report for entry in stated) and "data:image/png;base64," in report
    assert 'src="http' not in report and "<script" not in report
    assert report.index("Claims") < report.index("Fig. 8")
    assert "width=device-width" in report and "<style>body{" in report
    assert (
        report.index("claims") < report.index("Claims</h2>") < report.index("Provenance") < report.index("Words</h2>")
    )
    assert "torchfovea reproduce " in report and "took no part" in report and " nats" in report
    small = [entry for entry in stated if entry["verdict"] == "undecided" and entry["p_value"] is not None]
    assert report.count("n too small to decide<") == len(small) > 0  # of two or three scenes none can decide
    lines = (folder / "episodes.csv").read_text().splitlines()
    assert len(lines) == 1 + result["episodes"] == 1 + 2 * (2 * 3 + 2)

    # a killed run, started again, makes what is missing and the same table
    (folder / "result.json").unlink()
    parts = sorted((folder / "cells").iterdir())
    kept = {path: path.stat().st_mtime_ns for path in parts[1:]}
    parts[0].unlink()
    assert main(command) == 0
    assert (folder / "episodes.csv").read_text().splitlines() == lines
    assert {path: path.stat().st_mtime_ns for path in parts[1:]} == kept

    # a complete run is not run again; other settings are refused; a corrupt part is named
    assert main(command) == 0
    capsys.readouterr()
    assert main([*command, "saccades=3"]) == 1
    assert "made with other settings" in capsys.readouterr().err
    (folder / "result.json").unlink()
    parts[0].write_text("[{")
    assert main(command) == 1
    assert parts[0].name in capsys.readouterr().err


def test_failed_cells_are_named_and_the_rest_is_kept(tmp_path, capsys):
    folder = tmp_path / "run"
    changes = ["fig8.others=[pi,external]", "fig9.biases=[unbiased]"]
    assert main(["reproduce", *SMALL, *changes, f"hydra.run.dir={folder}"]) == 1
    said = capsys.readouterr().err
    assert "acquisition.source" in said and "external" in said and "2 of 7 failed" in said
    assert len(list((folder / "cells").iterdir())) == 5 and not (folder / "result.json").exists()


def test_verdicts_are_data():
    row = asdict(judge_claims([claim()], rows_of({"a": noisy(1.0), "b": noisy(0.0)}))[0])
    assert all(value is None or isinstance(value, str | int) or math.isfinite(value) for value in row.values())


def test_ablation_and_photometric_cells_are_settings_of_search():
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("reproduce", overrides=["ablation=true", "photometric=true"], return_hydra_config=True)
        from hydra.core.hydra_config import HydraConfig

        HydraConfig.instance().set_config(cfg)
        plain = OmegaConf.to_container(OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"]), resolve=True)
        tasks = cells.cells_of(plain)
        in_far = cells.in_family({**plain, "in_family": "far", "ablation": False, "photometric": False})
        with pytest.raises(SettingError, match="in_family = near: expected null, or one of far"):
            cells.in_family({**plain, "in_family": "near"})
        far = compose("search", overrides=list(cells.cells_of(in_far)[0].overrides))
        wanted = {t.overrides for t in tasks if t.labels["fig"] in ("ablation", "photometric")}
        for overrides in wanted:
            compose("search", overrides=list(overrides))
    assert {task.labels["scene"] for task in cells.cells_of(in_far)} == {"far"} == {in_far["counts"]["scene"]}
    # the family's scene and noise, and the reproduction's own sizes
    assert (far.scene.name, far.budget.match_px, far.saccades) == ("far", 0.3, cfg.saccades)
    assert len(wanted) == len(cfg.ablations) + 1 + 2
    names = [cells.task_name(task) for task in tasks]
    assert len(names) == len(set(names))


def test_python_dash_m_runs_it_too():
    done = subprocess.run(
        [sys.executable, "-m", "torchfovea", "reproduce", "--help"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and "ablations" in done.stdout
