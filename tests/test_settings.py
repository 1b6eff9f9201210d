"""Settings that no command can work with: one line that names each, at once, and nothing left behind."""

import time

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig

from torchfovea.cli import main
from torchfovea.commands.shared.config import conf_dir

SEARCH = "fidelity=geometric episodes=1 saccades=2 sensor.receptive_fields=400 memory.cells=60 picture=false"
TUNE = "profile=quick episodes=64 validations=2 validation_scenes=16 heldout_scenes=32 prior_field=false"
START = {"search": SEARCH.split(), "tune": TUNE.split()}
HUGE = [  # no answer, or an allocation, until they were bounded
    ("search", "sensor.receptive_fields=1e9"),
    ("search", "sensor.receptive_fields=1e300"),
    ("search", "memory.cells=1e12"),
    ("search", "seed=1e300"),
    ("search", "budget.sigma_over_width=1e300"),
    ("search", "fusion.gate_deg=1e300"),
    ("search", "prior.std=1e20"),
    ("search", "far_m=1e300"),
    ("calibrate", "scenes=1e9"),
    ("reproduce", "saccades=1e300"),
    ("doctor", "probe_timeout_s=inf"),
    ("tune", "sensor.fov_deg=1e-300"),
    ("tune", "prior.std=1e-300"),
]
WRONG = [  # tracebacks, or accepted in silence
    ("search", "eligibility.ground_z_m=nan"),
    ("search", "eligibility.nearest_m=inf"),
    ("search", "renderer.name={a: 1}"),
    ("search", "scene.can_radius_m=nan"),
    ("search", "head.baseline_m=inf"),
    ("search", "fusion.fill=no"),
    ("search", "matcher.disparities=1000000000"),
    ("bench", "paths=inf"),
    ("reproduce", "seed=''"),
    ("tune", "distribution.front_m=abc"),
    ("tune", "distribution.height_m=inf"),
    ("tune", "distribution.range_m=nan"),
    ("tune", "distribution.regions=[[a,1,2,3]]"),
    ("tune", "distribution.task_spread_deg=abc"),
    ("tune", "distribution.conditioned=nan"),
    ("tune", "acquisition.alpha={a: 1}"),
    ("tune", "tune_alpha=nan"),
    ("tune", "resume=1"),
    ("tune", "methods=0.5"),
    ("tune", "estimators=nan"),
]
UNREAD = [  # of groups that a command shares with others
    ("bench", "distribution=left_below"),
    ("sense", "sensor.fov_deg=60"),
    ("sense", "sensor.camera=fisheye"),
    ("sense", "sensor.sample=100"),
    ("calibrate", "sensor.sample=100"),
    ("calibrate", "episodes=3"),
    ("calibrate", "saccades=3"),
    ("calibrate", "memory.cells=100"),
    ("characterize", "episodes=3"),
    ("characterize", "saccades=3"),
    ("characterize", "memory.cells=100"),
    ("characterize", "budget.source=false"),
    ("characterize", "budget.sigma_points=paper"),
    ("tune", "head.encoder_deg=1"),
    ("tune", "sensor.sample=100"),
    ("tune", "budget.bend=0.3"),
    ("tune", "budget.gap=0.3"),
    ("tune", "budget.claim=2"),
    ("tune", "fusion.gate_deg=2"),
    ("tune", "fusion.half_life=3"),
    ("tune", "prior.slope_std=2"),
    ("tune", "prior.bearing_std=0.2"),
]


@pytest.mark.parametrize(("command", "override"), HUGE + WRONG + UNREAD, ids=str)
def test_one_line_names_it_and_nothing_is_left(command, override, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    began = time.process_time()
    folder = tmp_path / "run"
    assert main([command, *START.get(command, []), override, f"hydra.run.dir={folder}"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"torchfovea {command}: ") and len(said.splitlines()) == 1, said
    name = override.partition("=")[0]
    assert name.rpartition(".")[2] in said and "expected" in said
    assert not folder.exists()
    assert time.process_time() - began < 20


@pytest.mark.parametrize("command", ["search", "tune", "calibrate", "characterize", "bench", "reproduce"])
@pytest.mark.parametrize("profile", ["quick", "reduced", "paper"])
def test_every_command_has_every_profile(command, profile, monkeypatch):
    """And of the paper's sizes is what the paper states: 50 saccades, all receptive fields, 20,000 cells."""
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose(command, overrides=[f"profile={profile}"], return_hydra_config=True)
        if command in ("search", "reproduce") and profile == "paper":
            monkeypatch.setattr(HydraConfig.instance(), "cfg", cfg)  # for interpolations
            assert (cfg.saccades, cfg.memory.cells) == (50, 20000)
            assert cfg.sensor.sample is None and cfg.sensor.receptive_fields == 31416
    assert "profile" in cfg.hydra.runtime.choices


def test_a_profile_that_is_gone_is_named(capsys, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    assert main(["search", "profile=full"]) == 1
    assert "profile = full: expected one of paper, quick, reduced" in capsys.readouterr().err


def test_a_setting_that_is_gone_names_what_does_its_work(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["search", "fusion.erode=0.5"]) != 0
    error = capsys.readouterr().err
    assert "fusion.erode = 0.5: expected fusion.window" in error and len(error.splitlines()) == 1
