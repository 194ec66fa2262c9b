from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as parquet
import pytest
import tyro

from triform import __version__
from triform.cli import COMMANDS, main
from triform.commands.options import CONFIG, registry
from triform.commands.show import Show
from triform.files import exclusive
from triform.training import PRESETS

#: A preset that learns an expert from demonstrations, and one that learns the triangulating law from scenes.
DEMONSTRATED = next(name for name, preset in PRESETS.items() if preset.scenes is None and preset.maps is not None)
SCENES = next(name for name, preset in PRESETS.items() if preset.scenes is not None)
#: A short evaluation; the name of its file comes next.
QUICK = ["evaluate", "--controller", "expert", "--robots", "3", "--runs", "1", "--duration", "5", "--json"]


def test_version_and_overview(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == __version__
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)
    assert all(f"\n{command.group}:\n" in shown and command.example in shown for command in COMMANDS.values())


@pytest.mark.parametrize("arguments", [[], ["nonsense"]])
def test_a_wrong_command_is_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert "usage: triform COMMAND" in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_status:
        main([name, "--help"])
    assert exit_status.value.code == 0
    assert f"usage: triform {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["evaluate", "--runs", "0"], "runs is 0"),
        (["evaluate", "--robots", "0"], "robots is 0"),
        (["evaluate", "--controller", "magic"], "no controller 'magic'"),
        (["evaluate", "--profile", "moon"], "no profile 'moon'"),
        (["evaluate", "--arena", "pilars"], "did you mean 'pillars'"),
        (["evaluate", "--event", "explode"], "explode"),
        (["evaluate", "--duration", "4"], "duration is 4"),
        (["reproduce", "fig99"], "fig99"),
        (["train"], "--out"),
        (["show", "policies", "paper"], "only listed"),
        (["show", "intensities"], "name is missing; intensities are those of a recording"),
        (["evaluate", "--simulator", "gazebo", "--min-intensity", "230"], "Gazebo's"),
        (["evaluate", "--profile", "turtlebot4", "--min-intensity", "230"], "but the LiDAR of the profile"),
        (["drive", "--lidar-model", "rplidar-a1"], "run its ROS 2 driver"),
    ],
)
def test_wrong_options_are_wrong_usage(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_status:
        main(arguments)
    assert exit_status.value.code == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["evaluate", "--controller", "policy:nowhere"], "no policy 'nowhere'"),
        (["evaluate", "--starts", "missing.csv"], "missing.csv"),
        (["export", "missing"], "holds no policy"),
        (["show", "intensities", "missing"], "missing/scans.csv cannot be read: no such file"),
        (["collect", "--out", "data", "--teacher", "nobody"], "no expert 'nobody'"),
        (["train", "--out", "run", "--preset", "paper"], "--data"),
        (["train", "--out", "run", "--preset", DEMONSTRATED, "--data", "missing"], "missing"),
        (["train", "--out", "run", "--preset", SCENES, "--data", "missing"], "reads no --data"),
        (["train", "--out", "run", "--maps", "0"], "maps is 0"),
        (["train", "--out", "run", "--profile", "moon"], "no profile 'moon'"),
        (["train", "--out", "run", "--preset", "springs", "--profile", "hardware"], "draws no scenes"),
        (["train", "--out", "run", "--device", "abacus"], "abacus"),
        (["train", "--out", "run", "--device", "meta"], "cpu or cuda"),
        (["train", "--out", "run", "--learning-rate", "inf"], "learning_rate"),
        (["train", "--out", "file/run", "--maps", "500"], "cannot write"),
        (["collect", "--out", "file/data"], "cannot write"),
        (["evaluate", "--robots", "3", "--json", "file/out.json"], "cannot write"),
        (["reproduce", "--output", "file/results"], "cannot write"),
        (["demo", "--output", "file/demo"], "cannot write"),
        (["evaluate", "--controller", "policy:file"], "is a file"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(arguments) == 1
    shown = capsys.readouterr().err
    assert shown.startswith("triform: ")
    assert says in shown
    assert len(shown.strip().splitlines()) == 1


def test_evaluate_writes_summary_and_runs(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    command = "evaluate --robots 3 4 --runs 2 --seed 7 --duration 8 --controller expert-sensed --json"
    assert main([*command.split(), str(out)]) == 0
    summary = json.loads(out.read_text())
    assert [result["robots"] for result in summary["results"]] == [3, 4]
    assert {"success", "strict", "formation_error_median", "min_distance", "collision"} <= summary["results"][0].keys()
    assert parquet.read_table(tmp_path / "out.parquet").num_rows == 4


def test_collect_train_export_evaluate(tmp_path: Path) -> None:
    data, run = tmp_path / "data", tmp_path / "run"
    collect = ["collect", "--out", str(data), "--runs", "2", "--steps", "10", "--placements", "100"]
    assert main(collect) == 0
    assert main(collect) == 0
    train = ["train", "--out", str(run), "--preset", DEMONSTRATED, "--data", str(data), "--maps", "500"]
    assert main(train) == 0
    assert main([*train, "--resume"]) == 0
    assert main(["train", "--out", str(tmp_path / "scenes"), "--preset", SCENES, "--data", str(data)]) == 1
    assert not (tmp_path / "scenes").exists()
    assert main(["export", str(run / "best")]) == 0
    evaluate = ["evaluate", "--controller", f"policy:{run / 'best'}", "--robots", "3", "--runs", "1", "--duration", "6"]
    assert main(evaluate) == 0


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_training_says_so_and_resumes(tmp_path: Path, stop: signal.Signals) -> None:
    train = ["train", "--out", str(tmp_path), "--preset", DEMONSTRATED, "--maps", "6000"]
    command = [sys.executable, "-m", "triform.cli", *train]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    while not (tmp_path / "log.jsonl").exists():
        assert child.poll() is None
        time.sleep(0.05)
    child.send_signal(stop)
    _, errors = child.communicate()
    assert child.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert (tmp_path / "state.safetensors").exists()
    assert main([*train, "--resume"]) == 0


def test_the_first_command_says_that_it_compiles(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "triform", "evaluate", "--robots", "3", "--runs", "1", "--duration", "5"]
    command += ["--controller", "expert", "--json", str(tmp_path / "out.json")]
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    told, took, simulated = [], [], []
    for _ in range(2):
        began = time.monotonic()
        told.append(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr)
        took.append(time.monotonic() - began)
        simulated.append(json.loads((tmp_path / "out.json").read_text())["wall_seconds"])
    assert told == ["compiling kernels, once after an installation: about a minute\n", ""]
    # What compiling takes is no time of simulating.
    assert simulated[0] < (took[0] - took[1]) / 2


def test_a_mistyped_command_is_guessed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evalute"]) == 2
    assert "there is no command 'evalute' (did you mean 'evaluate'?)" in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_of_every_command_parses(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(COMMANDS[name].example)
    assert words[:2] == ["triform", name]
    tyro.cli(COMMANDS[name].load(), args=words[2:], config=CONFIG, registry=registry)


def test_without_a_terminal_lines_tell_how_far_a_command_is(capsys) -> None:
    expert = ["--controller", "expert", "--runs", "1"]
    assert main(["evaluate", "--robots", "1", "2", "--duration", "6", *expert]) == 0
    assert len([line for line in capsys.readouterr().out.splitlines() if line.startswith("done after")]) == 2
    assert main(["evaluate", "--robots", "3", "--duration", "12", "--event", "join@6", *expert]) == 0
    assert len([line for line in capsys.readouterr().out.splitlines() if line.startswith("done after")]) == 1


@pytest.mark.parametrize("command", ["collect", "train"])
def test_a_refusal_before_the_work_stands_alone(command: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "foreign").touch()
    refused = {"collect": [], "train": ["--data", str(tmp_path / "none")]}[command]
    assert main([command, "--out", str(tmp_path), *refused]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines()[-1].startswith("triform: ")


def test_a_missing_extra_is_named(tmp_path: Path) -> None:
    """Without PyTorch, evaluation runs and training says what to install."""
    blocked = tmp_path / "torch"
    blocked.mkdir()
    (blocked / "__init__.py").write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')\n")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    train = [sys.executable, "-m", "triform.cli", "train", "--out", str(tmp_path / "run")]
    done = subprocess.run(train, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    needed = "train needs torch, which the extra 'train' installs: pip install 'triform[train]'"
    assert done.stderr == f"triform: {needed}, or in a checkout pip install '.[train]'\n"
    evaluate = ["evaluate", "--controller", "policy", "--robots", "3", "--runs", "1", "--duration", "6"]
    done = subprocess.run(
        [sys.executable, "-m", "triform.cli", *evaluate], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_an_extra_is_named_by_its_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr(Show, "run", lambda *_: __import__("PIL.Image"))
    assert main(["show", "profile"]) == 1
    assert capsys.readouterr().err.startswith("triform: show needs pillow, which the extra 'evaluate' installs: pip")


def test_one_and_two_robots_have_defined_results(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    assert main(["evaluate", "--robots", "1", "2", "--runs", "2", "--duration", "10", "--json", str(out)]) == 0
    alone, pair = json.loads(out.read_text())["results"]
    assert alone["formation_error_median"] is None
    assert alone["success"] == 0
    assert pair["success"] == 1
    assert pair["strict"] == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["collect", "--preset", "paper", "--out", "out"],
        ["evaluate", "--runs", "1000", "--json", "out/out.json"],
        ["reproduce", "--output", "out"],
        ["demo", "--duration", "100000", "--output", "out"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_ctrl_c_ends_every_long_command_in_one_sentence(arguments: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "triform.cli", *arguments]
    child = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    # Every command makes its output folder before it begins.
    while not (tmp_path / "out").exists():
        assert child.poll() is None, child.communicate()
        time.sleep(0.05)
    time.sleep(0.5)
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode == 130
    assert errors.startswith("triform: interrupted")
    assert "Traceback" not in errors


def test_output_that_finds_no_reader_ends_without_a_traceback() -> None:
    program = f"{sys.executable} -m triform"
    done = subprocess.run(
        ["bash", "-c", f"for i in 1 2 3; do {program} evaluate --help | head -1; done"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert done.stdout.count("usage: triform evaluate") == 3


@pytest.mark.parametrize("redirection", [">/dev/full", ">&-", "2>/dev/full >/dev/full"])
@pytest.mark.parametrize("arguments", ["--help", "show profile", "show profile hardware", "evaluate --help"])
def test_output_that_cannot_be_written_ends_in_a_sentence(arguments: str, redirection: str) -> None:
    command = f"{sys.executable} -m triform {arguments} {redirection}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == (0 if redirection == ">&-" else 1)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    if redirection == ">/dev/full":
        assert done.stderr.startswith("triform: cannot write the output: no space left")


@pytest.mark.parametrize("name", ["x[/].json", "[bold]x.json", ":smile:.json", "\x1b[31mx.json", "x\udcff.json"])
def test_names_of_files_are_text_and_no_markup(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*QUICK, name]) == 0
    out = capsys.readouterr().out
    shown = name.encode("unicode_escape").decode() if name[0] == "\x1b" or name[1] == "\udcff" else name
    assert f"wrote {Path(shown)}" in out
    assert len(list(tmp_path.rglob("*.parquet"))) == 1


@pytest.mark.parametrize("name", ["[/]", "[bold]x", "\x1b[31m", ":smile:", "\udcff"])
@pytest.mark.parametrize(
    "arguments",
    ["evaluate --profile", "evaluate --controller", "evaluate --runs", "evaluate --event", "measure", "export", "show",
     "demo --arena", "collect --teacher", "", "drive --lidar", "reproduce"],
)  # fmt: skip
def test_what_users_write_is_shown_as_it_is(arguments: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main([*arguments.split(), name])
    except SystemExit as ended:
        status = int(str(ended.code))
    assert status in (1, 2)
    shown = capsys.readouterr().err
    assert all(each.isprintable() or each == "\n" for each in shown)
    assert "\u263a" not in shown


def test_a_result_never_replaces_a_device(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    device = tmp_path / "null"
    device.symlink_to("/dev/null")
    assert (
        main(
            [
                *["evaluate", "--controller", "expert", "--robots", "3", "--runs", "1", "--duration", "5", "--json"],
                str(device),
            ]
        )
        == 1
    )
    assert "is a device" in capsys.readouterr().err
    assert device.is_symlink()


@pytest.mark.parametrize("command", ["compare", "conditions", "ablate", "reproduce", "demo", "gallery"])
def test_a_folder_has_one_writer(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with exclusive(tmp_path):
        assert main([command, "--output", str(tmp_path)]) == 1
    assert "another process" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("endless.toml", ["evaluate", "--profile", "endless.toml"]),
        ("endless.npy", ["evaluate", "--starts", "endless.npy"]),
        ("endless.csv", ["measure", "endless.csv"]),
        ("endless.py", ["evaluate", "--controller", "endless.py:Mine"]),
    ],
)
def test_a_file_that_never_ends_is_refused(name, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).symlink_to("/dev/zero")
    try:
        status = main(words)
    except SystemExit as end:  # of the command line's own parser
        status = end.code
    assert status in (1, 2)
    assert "it is a device, and a file is needed" in " ".join(capsys.readouterr().err.replace("│", " ").split())
