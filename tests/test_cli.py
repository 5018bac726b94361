"""The command line as its user meets it: quick help, one clear line for every mistake, the same rows on every way."""

import contextlib
import io
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time

import pytest

from tab_marl import cli
from tab_marl.evaluation import settings
from tab_marl.evaluation.errors import user_message
from tab_marl.evaluation.store import FILE_NAME

SMALL = [
    "--missions",
    "M1",
    "--families",
    "point",
    "--planners",
    "FP-POMCP,MLE-POMCP,random",
    "--adversaries",
    "scripted",
]


def call(capsys, monkeypatch, *arguments):
    """(status, stdout, stderr) of a command in this process."""
    monkeypatch.setattr(sys, "argv", ["tab-marl", *map(str, arguments)])
    handler = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        signal.signal(signal.SIGTERM, handler)
    out, err = capsys.readouterr()
    return ended.value.code, out, err


def test_help_is_quick_and_imports_nothing_heavy():
    code = (
        "import sys; sys.argv = ['tab-marl', 'evaluate', '--help']\n"
        "from tab_marl import cli\n"
        "try: cli.main()\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'numba', 'torch', 'scipy', 'pymunk', 'matplotlib', 'stable_baselines3', 'jinja2'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "--missions" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "--missions", "M7"], "no mission named 'M7'"),
        (["evaluate", "--families", "poimt"], "did you mean 'point'"),
        (["evaluate", "--planners", "TAB-PONCP"], "did you mean 'TAB-POMCP'"),
        (["evaluate", "--adversaries", "drect"], "no adversary named 'drect': did you mean 'direct'"),
        (["evaluate", "--adversaries", "./no/such/policy"], "no/such/policy is not a policy"),
        (["evaluate", "--episodes", "0"], "episodes is 0, must be >= 1"),
        (["evaluate", "--episodes", "three"], "'--episodes'"),
        (["evaluate", "--config", "none.toml"], "none.toml: there is no such file"),
        (["evaluate", "--preset", "papr"], "did you mean 'paper'"),
        (["evaluat"], "No such command 'evaluat'"),
        (["evaluate", "--epsiodes", "3"], "No such option"),
        (["report", "--out", "nothing/here"], "no evaluation is stored here"),
        (["field", "Reach Checkpiont A within 16s"], "did you mean 'Checkpoint A'"),
        (["field", "Reach Checkpoint A within 3s", "--start", "scenario"], "allows 3 s"),
        (["field", "Reach Checkpoint A in exactly 9s, then Checkpoint C within 2s"], "the mission is impossible"),
        (["field", "Go home"], "cannot read the mission"),
        (["field", "Reach Checkpoint A within 16s", "--animation", "a.avi"], "end the name in .gif or .mp4"),
        (["field", "Reach Checkpoint A within 16s", "--answers", "a.xls"], "end the name in .json or .csv"),
        (["field", "Reach Checkpoint A within 16s", "--passes", "Checkpoint D"], "PLACE=PROBABILITY"),
        (["field", "Reach Checkpoint A within 16s", "--passes", "Checkpoint Q=0.3"], "Checkpoint Q"),
        (["field", "Reach Checkpoint A within 16s", "--completes", "1.5"], "must lie in (0, 1]"),
        (["field", "Reach Checkpoint A within 16s", "--start", "9,9"], "outside the arena"),
        (["field", "Reach Checkpoint A within 16s", "--scenario", "lav"], "did you mean 'lab'"),
        (["field", "Reach Checkpoint A within 16s", "--out", "/dev/null/x.png"], "cannot be written"),
        (["watch", "--planner", "TAB"], "no planner named 'TAB'"),
        (["watch", "--out", "a.avi"], "cannot write .avi films"),
        (["watch", "--out", "a.gif", "--mission", "Go home", "--scenario", "lab"], "cannot read the mission"),
        (["train", "--style", "sidee"], "did you mean 'side'"),
        (["train", "--steps", "0"], "steps is 0, must be >= 1"),
        (["train", "--config", "none.toml"], "none.toml"),
        (["train", "none.toml"], "none.toml"),
        (["train", "shipped", "--style", "side"], "--style is for a single policy"),
        (["train", "shipped", "--only", "sied"], "did you mean 'side'"),
        (["train", "shipped", "--steps", "-3"], "steps is -3, must be >= 1"),
        (["train", "--workers", "2"], "--only and --workers are for a population"),
        (["zoo", "show", "drect"], "did you mean 'direct'"),
        (["zoo", "list", "--split", "finl"], "did you mean 'final'"),
        (["zoo", "add", "none.zip", "--name", "x"], "none.zip is not a model that stable-baselines3 saved"),
        (["zoo", "add", "none.zip", "--name", "../x"], "name is '../x', must be"),
        (["evaluate", "--adversaries", "development,final"], "leave one out, or say --mix-splits"),
    ],
)
def test_every_mistake_is_one_clear_line(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    status, _, err = call(capsys, monkeypatch, *arguments)
    assert status != 0
    assert message in err
    assert err.startswith("tab-marl: ") and err.count("\n") == 1 and "Traceback" not in err
    assert not any(tmp_path.iterdir()), "a refused command leaves nothing behind"


def test_output_folder_that_cannot_be_made(capsys, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    status, _, err = call(capsys, monkeypatch, "evaluate", *SMALL, "--out", tmp_path / "file" / "out")
    assert status != 0 and "cannot be written" in err and err.count("\n") == 1


def test_window_without_a_display(capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    status, _, err = call(capsys, monkeypatch, "watch", "--adversary", "scripted")
    assert status != 0 and "--out episode.gif" in err


def test_a_bug_is_named_as_one(capsys, monkeypatch):
    from tab_marl.evaluation import zoo_view

    monkeypatch.delenv("TAB_MARL_TRACEBACK", raising=False)
    monkeypatch.setattr(zoo_view, "zoo_table", lambda *_: 1 / 0)
    status, _, err = call(capsys, monkeypatch, "zoo", "list")
    assert status == cli.EXIT_BUG
    assert err == "tab-marl: internal error: ZeroDivisionError: division by zero (TAB_MARL_TRACEBACK=1 shows where)\n"
    monkeypatch.setenv("TAB_MARL_TRACEBACK", "1")
    monkeypatch.setattr(sys, "argv", ["tab-marl", "zoo", "list"])
    with pytest.raises(ZeroDivisionError):
        cli.main()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(28, "No space left on device", "runs/x"), "runs/x: No space left on device"),
        (sqlite3.OperationalError("disk I/O error"), "the store cannot be used: disk I/O error"),
        (MemoryError(), "out of memory"),
        (KeyError("oops"), None),
    ],
)
def test_errors_of_the_machine_have_words(error, message):
    found = user_message(error)
    assert found is None if message is None else message in found


def contents(folder):
    with sqlite3.connect(folder / FILE_NAME) as store:
        return store.execute("SELECT * FROM episodes ORDER BY 1, 2, 3, 4, 5").fetchall()


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """(folder, what was printed) of a small evaluation by one worker; the code's fingerprint is held fixed meanwhile."""
    folder = tmp_path_factory.mktemp("evaluation")
    options = ["--episodes", "2", "--workers", "1", "--replays", "1", "--out", str(folder / "one")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "code_fingerprint", lambda: "code")
        patch.setattr(sys, "argv", ["tab-marl", "evaluate", *SMALL, *options])
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 0
        yield folder, printed.getvalue()


def test_evaluate_prints_the_table_and_writes_the_report(evaluated):
    folder, printed = evaluated
    assert "family: point" in printed and "78.0" in printed  # the paper's FP-POMCP on M1
    page = (folder / "one" / "report.html").read_text(encoding="utf-8")
    assert page.count('"planner":') == 3 and "scripted" in page and "unlike the stored episode" not in page
    assert len(contents(folder / "one")) == 6


def test_two_workers_give_identical_rows(evaluated, capsys, monkeypatch):
    folder, _ = evaluated
    options = ["--episodes", 2, "--workers", 2, "--replays", 0, "--out", folder / "two"]
    status, _, err = call(capsys, monkeypatch, "evaluate", *SMALL, *options)
    assert status == 0, err
    assert contents(folder / "two") == contents(folder / "one")


def test_the_same_command_again_plays_nothing(evaluated, capsys, monkeypatch):
    folder, _ = evaluated
    before = contents(folder / "one")
    options = ["--episodes", 2, "--replays", 0, "--out", folder / "one"]
    status, _, err = call(capsys, monkeypatch, "evaluate", *SMALL, *options)
    assert status == 0 and "all 6 episodes are already stored" in err
    assert contents(folder / "one") == before


def test_other_settings_are_kept_apart(evaluated, capsys, monkeypatch):
    folder, _ = evaluated
    other = folder / "apart"
    shutil.copytree(folder / "one", other)
    options = ["--missions", "M1", "--families", "point", "--planners", "random", "--adversaries", "scripted"]
    options += ["--seed", 5, "--episodes", 1, "--replays", 0, "--out", other]
    status, _, err = call(capsys, monkeypatch, "evaluate", *options)
    assert status == 0 and "kept apart" in err
    assert len(contents(other)) == 7 and len({row[0] for row in contents(other)}) == 2
    status, out, err = call(capsys, monkeypatch, "report", "--out", other, "--replays", 0)
    assert "the latest of 2" in err and re.search(r"random +1 ", out)


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_interrupted_says_how_to_go_on_and_goes_on(tmp_path):
    arguments = [
        "evaluate",
        *SMALL,
        "--episodes",
        "40",
        "--workers",
        "1",
        "--replays",
        "0",
        "--out",
        str(tmp_path / "i"),
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "tab_marl.cli", *arguments], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if (tmp_path / "i" / FILE_NAME).exists() and len(contents_or_nothing(tmp_path / "i")) >= 3:
            break
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode not in (0, None)
    last = err.strip().splitlines()[-1]
    assert re.search(r"interrupted: \d+ of 120 episodes are stored; to continue: tab-marl evaluate", last)
    assert "Traceback" not in err
    stored = contents(tmp_path / "i")
    assert 3 <= len(stored) < 120


def contents_or_nothing(folder):
    try:
        return contents(folder)
    except sqlite3.OperationalError:
        return []
