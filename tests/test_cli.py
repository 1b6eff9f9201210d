"""The command line: what it prints, where it writes, and one line for each mistake."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from joblib.externals.loky import get_reusable_executor

import torchfovea
from torchfovea.cli import COMMANDS, Command, main
from torchfovea.commands.shared.mistakes import arranged

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def job(tmp_path, monkeypatch):
    """Put a function of our own behind the command ``doctor``; runs write below ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def put(body):
        code = "from torchfovea.setting import require\n\ndef run(cfg):\n" + "\n".join(
            f"    {x}" for x in body.split("\n")
        )
        (tmp_path / "job_under_test.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, "job_under_test", raising=False)
        monkeypatch.setitem(COMMANDS, "doctor", Command("job_under_test:run", "", ()))

    return put


def fails_with(capsys, line, *arguments, status=1):
    """Run the command; it must fail with exactly this line."""
    assert main(["doctor", *arguments]) == status
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == [f"torchfovea doctor: {line}"]


def test_help_lists_the_commands(capsys):
    for arguments in ([], ["--help"], ["-h"]):
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        for name, command in COMMANDS.items():
            assert name in printed
            assert command.summary in printed
            assert command.examples[0] in printed


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"torchfovea {torchfovea.__version__}\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_function_and_its_configuration(name):
    import importlib

    module, _, function = COMMANDS[name].target.partition(":")
    assert callable(getattr(importlib.import_module(module), function))
    assert (ROOT / "conf" / f"{name}.yaml").is_file()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_shows_its_settings(name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([name, "--help"]) == 0
    said = capsys.readouterr().out
    assert "seed: 0" in said
    assert [line.strip() for line in said.splitlines()[2:5]] == list(COMMANDS[name].examples)
    assert list(tmp_path.iterdir()) == []


def test_help_has_the_comments_of_the_settings(capsys):
    assert main(["search", "--help"]) == 0
    said = capsys.readouterr().out
    assert "# photometric: images, matched; geometric: surface points by ray casting" in said
    assert "# fusion=aligned|inverse_range|printed; now inverse_range" in said and "  gate_deg: 0.8" in said
    assert "hydra:" not in said and "defaults:" not in said and "@package" not in said


@pytest.mark.skipif(os.name != "posix", reason="pipes are POSIX")
@pytest.mark.parametrize("arguments", [["--help"], ["search", "--help"]])
def test_a_reader_that_leaves_early_is_no_error(arguments, tmp_path):
    command = [sys.executable, "-m", "torchfovea", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    read, write = os.pipe()
    os.close(read)  # nobody reads at all
    try:
        done = subprocess.run(
            command, stdout=write, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment, timeout=240
        )
    finally:
        os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.skipif(os.name != "posix", reason="shells are POSIX")
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_command_whose_streams_are_closed_ends_as_ever(closed, tmp_path):
    command = f"exec {sys.executable} -m torchfovea --version {closed}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["sh", "-c", command], capture_output=True, cwd=tmp_path, env=environment, timeout=240)
    assert (done.returncode, done.stderr) == (0, b"")
    assert list(tmp_path.iterdir()) == []


def test_flags_may_stand_anywhere_and_unknown_ones_are_named(job, capsys):
    job("return float(cfg.seed)")
    assert main(["doctor", "probe_timeout_s=2", "-m", "seed=0,1"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    for flags, said in (
        (["--hlp"], "--hlp: expected SETTING=VALUE, or a flag such as --help (did you mean --help?)"),
        (["seed=1", "--config-dir"], "--config-dir = nothing: expected a value after it"),
        (["--config-dir", "nowhere"], "--config-dir = nowhere: expected an existing folder"),
        (["hydra.run.dir="], "hydra.run.dir = nothing: expected a folder"),
    ):
        assert main(["doctor", *flags]) == 2
        assert capsys.readouterr().err == f"torchfovea doctor: {said}\n"


@pytest.mark.parametrize("path", ["müde/l übung.png", "left (1).png", "片目.png", "plain.png"])
def test_paths_need_no_quotes_that_a_shell_would_not_ask_for(path):
    (setting,) = arranged([f"memory.load={path}"])
    assert OverridesParser.create().parse_override(setting).value() == path


@pytest.mark.parametrize("setting", ["a=[1", "a='x'", "a=${b}", "a=1,2", "a=", "~a", "a={b:1}", "a=x y", "a", "a=\\"])
def test_what_hydra_means_is_left_to_it(setting):
    assert arranged([setting]) == [setting]


def test_several_values_without_a_sweep_are_named(job, capsys):
    job("raise AssertionError('must not run')")
    expected = "seed = 0,1: expected one value, a list [0,1], or --multirun, which runs each of them"
    fails_with(capsys, expected, "seed=0,1")


def test_a_broken_file_of_a_group_is_named(job, capsys, tmp_path):
    (tmp_path / "budget").mkdir()
    (tmp_path / "budget" / "broken.yaml").write_text("sigma_over_width: [1\n  bad: : x\n")
    assert main(["search", "--config-dir", str(tmp_path), "budget=broken"]) == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "broken.yaml" in said and "line 2" in said


def test_a_package_that_the_end_needs_is_missed_at_the_beginning(job, capsys, monkeypatch):
    """Without matplotlib a search would find out after its episodes."""
    from torchfovea.commands.shared import mistakes

    find = mistakes.importlib.util.find_spec
    monkeypatch.setattr(mistakes.importlib.util, "find_spec", lambda n: None if n == "matplotlib" else find(n))
    COMMANDS["doctor"] = COMMANDS["doctor"]._replace(draws=True)
    job_ran = []
    monkeypatch.setattr("torchfovea.files.write_result", lambda *a: job_ran.append(a))
    fails_with(capsys, "matplotlib is not installed: expected the extra viz (pip install 'torchfovea[viz]')")
    assert not job_ran
    assert main(["doctor", "+picture=false"]) == 0


def test_unknown_command(capsys):
    assert main(["docter"]) == 2
    names = ", ".join(COMMANDS)
    line = f"torchfovea: command = docter: expected one of {names} (did you mean doctor?)\n"
    assert capsys.readouterr().err == line


def test_a_run_prints_its_folder_last_and_keeps_its_settings(job, capsys, tmp_path):
    job("from torchfovea.commands.shared.config import run_folder\n(run_folder() / 'x').touch()\nprint('hello')")
    assert main(["doctor", "seed=7"]) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert first == "hello"
    assert Path(last).parent == tmp_path / "outputs" / "doctor"
    assert {entry.name for entry in Path(last).iterdir()} == {".hydra", "doctor.log", "x"}
    assert "seed: 7" in (Path(last) / ".hydra" / "config.yaml").read_text()


def test_a_run_says_what_to_open(job, capsys):
    names = ["points.ply", "report.html", "a.png", "b.png", "c.png", "d.png", "e.png", "x.csv", "settings.yaml"]
    job(f"from torchfovea.commands.shared.config import run_folder\n[(run_folder() / n).touch() for n in {names}]")
    assert main(["doctor"]) == 0
    *opened, folder = capsys.readouterr().out.splitlines()
    assert opened == [
        "open report.html: in a browser",
        "open a.png, b.png, c.png, d.png and 1 more: the pictures",
        "open points.ply: points, in MeshLab, CloudCompare or Open3D",
        "open x.csv: the figures, as a table",
    ]
    assert Path(folder).is_dir()


def test_a_setting_can_be_wrong(job, capsys, tmp_path):
    job("require(cfg.seed >= 0, 'seed', cfg.seed, 'a number >= 0')")
    fails_with(capsys, "seed = -1: expected a number >= 0", "seed=-1")
    assert not (tmp_path / "outputs").exists()


def test_a_failed_run_keeps_what_it_wrote(job, capsys, tmp_path):
    job(
        "import os\nfrom torchfovea.commands.shared.config import run_folder\n"
        "(run_folder() / 'x').touch()\nopen('nowhere.png')"
    )
    fails_with(capsys, "nowhere.png: No such file or directory")
    (folder,) = (tmp_path / "outputs" / "doctor").iterdir()
    assert (folder / "x").exists()


def test_mistakes_in_the_arguments(job, capsys, tmp_path):
    job("raise AssertionError('must not run')")
    fails_with(capsys, "sed = 3: expected a known setting (did you mean seed?)", "sed=3")
    fails_with(
        capsys, "probe_timeout.s = 3: expected a known setting (did you mean probe_timeout_s?)", "probe_timeout.s=3"
    )
    fails_with(capsys, "quick: expected SETTING=VALUE", "quick")
    assert main(["doctor", "hydra/launcher=foo"]) == 1
    assert capsys.readouterr().err.startswith("torchfovea doctor: hydra/launcher = foo: expected one of basic, ")
    assert main(["doctor", "seed=[1"]) == 1
    assert capsys.readouterr().err.startswith("torchfovea doctor: seed=[1: expected a value that Hydra can read")
    assert not (tmp_path / "outputs").exists()


def test_a_missing_value(job, capsys):
    job("cfg.seed")
    fails_with(capsys, "seed = ???: expected a value", "seed='???'")
    fails_with(capsys, "seed = ${nothing}: Interpolation key 'nothing' not found", "seed=${nothing}")


def test_a_missing_file_is_named_with_its_setting(job, capsys):
    job("open(cfg.left)")
    fails_with(capsys, "left = gone.png: No such file or directory", "+left=gone.png")


def test_a_missing_extra_is_named(job, capsys):
    job("raise ModuleNotFoundError(\"No module named 'cv2'\", name='cv2')")
    fails_with(capsys, "cv2 is not installed: expected the extra stereo (pip install 'torchfovea[stereo]')")


def test_mistakes_inside_an_instantiated_node_are_qualified(job, capsys, tmp_path):
    (tmp_path / "node_under_test.py").write_text(
        "from torchfovea.setting import require\n\n"
        "def make(fov_deg):\n    require(fov_deg < 180, 'fov_deg', fov_deg, 'less than 180')\n"
    )
    job("from hydra.utils import instantiate\ninstantiate(cfg.sensor)")
    node = ["+sensor._target_=node_under_test.make"]
    fails_with(capsys, "sensor.fov_deg = 200: expected less than 180", *node, "+sensor.fov_deg=200")
    fails_with(capsys, "sensor.x = 1: expected a setting that sensor has", *node, "+sensor.fov_deg=90", "+sensor.x=1")


def test_programming_errors_keep_their_traceback(job, capsys):
    job("[][0]")
    assert main(["doctor"]) == 1
    printed = capsys.readouterr().err
    assert printed.startswith("Traceback")
    assert printed.endswith("IndexError: list index out of range\n")
    job("cfg.seeed")
    assert main(["doctor"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_whole_tracebacks_on_demand(job, monkeypatch):
    job("require(False, 'seed', 1, 'another')")
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="seed = 1: expected another"):
        main(["doctor"])
    assert os.environ["HYDRA_FULL_ERROR"] == "1"


def test_the_process_is_left_as_it_was(job, capsys):
    job("pass")
    before = list(sys.argv)
    assert main(["doctor"]) == 0
    assert sys.argv == before
    assert "HYDRA_FULL_ERROR" not in os.environ


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_one_failing_job_does_not_stop_the_others(launcher, job, capfd, tmp_path):
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    job(
        "from torchfovea.files import write_result\nfrom torchfovea.commands.shared.config import run_folder\n"
        "require(cfg.seed != 1, 'seed', cfg.seed, 'another')\n"
        "assert cfg.seed != 2, 'a bug'\n"
        "write_result(run_folder(), {'seed': cfg.seed})"
    )
    if launcher == "joblib":
        # Workers look the command up for themselves: give them the real one, whose checks fail for one job.
        COMMANDS["doctor"] = Command("torchfovea.commands.doctor:run", "", ())
        # Those of an earlier sweep would keep its working folder and write to where its output went.
        get_reusable_executor().shutdown()
        sweep = [
            "save=true",
            "probe_timeout_s=60,-1",
            "hydra.launcher.n_jobs=2",
            f"hydra.sweep.dir={tmp_path}/multirun/doctor/it",
        ]
        failed = {"1": "probe_timeout_s = -1: expected a positive number of seconds, at most 1e6"}
        count = 2
    else:
        sweep = ["seed=0,1,2,3"]
        failed = {"1": "seed = 1: expected another", "2": "AssertionError: a bug"}
        count = 4
    assert main(["doctor", "-m", f"hydra/launcher={launcher}", *sweep]) == 1
    printed = capfd.readouterr()
    folder = Path(printed.out.splitlines()[-1])
    assert folder.parent == tmp_path / "multirun" / "doctor"
    finished = {path.parent.name for path in folder.glob("*/result.json")}
    assert finished == {str(n) for n in range(count)} - set(failed)
    for number, line in failed.items():
        assert [x for x in printed.err.splitlines() if f"job {number} (" in x and x.endswith(line)]
    assert ("Traceback" in printed.err) == (launcher == "basic")  # the bug's


def test_a_sweep_of_good_jobs_ends_well(job, capsys):
    job("return float(cfg.seed)")
    assert main(["doctor", "-m", "seed=0,1"]) == 0
    folders = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [folder.name for folder in folders[:2]] == ["0", "1"]
    assert folders[0].parent == folders[1].parent == folders[2]


def run_module(*arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "torchfovea", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment, timeout=240)


def test_doctor(tmp_path):
    done = run_module("doctor", "save=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.splitlines()[-1])
    result = json.loads((folder / "result.json").read_text())
    assert result["ok"] is True
    assert result["rays"] is True
    assert result["sgbm"] is True
    table = (folder / "doctor.csv").read_text().splitlines()
    assert table[0] == "item,found,note"
    assert {"torch", "kornia", "[sim]", "renderer=gl", "C++ compiler"} <= {line.split(",")[0] for line in table}


def test_doctor_names_a_probe_that_does_not_answer(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "probe_timeout_s=0.001"]) == 0
    assert "no answer within 0.001 s" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
    assert main(["doctor", "probe_timeout_s=0.001", "save=true"]) == 0
    printed = capsys.readouterr().out
    assert "no answer within 0.001 s" in printed
    result = json.loads((Path(printed.splitlines()[-1]) / "result.json").read_text())
    assert result["ok"] is False


def test_doctor_limit_must_be_a_time(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fails_with(capsys, "probe_timeout_s = soon: expected a number", "probe_timeout_s=soon")
    fails_with(capsys, "probe_timeout_s = -1: expected a positive number of seconds, at most 1e6", "probe_timeout_s=-1")


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_ctrl_c(tmp_path):
    (tmp_path / "waiting.py").write_text(
        "import signal, sys, time\nfrom torchfovea.cli import COMMANDS, Command, main\n"
        # as a terminal leaves it: a job in the background inherits it ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def run(cfg):\n    print('started', flush=True)\n    time.sleep(60)\n"
        "COMMANDS['doctor'] = Command('waiting:run', '', ())\n"
        "if __name__ == '__main__':\n    sys.exit(main(['doctor']))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(tmp_path)])}
    with subprocess.Popen(
        [sys.executable, "waiting.py"],
        cwd=tmp_path,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout.readline() == "started\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "interrupted\n"
