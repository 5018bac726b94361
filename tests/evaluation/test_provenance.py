"""What a run records: enough to repeat it, and nothing about who ran it where."""

import getpass
import json
import platform
import re
import subprocess
from importlib import metadata
from pathlib import Path

from tab_marl.evaluation import provenance
from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.evaluation.store import Store

SETTINGS = EvaluationSettings(adversaries=("direct", "/home/somebody/policies/mine"), episodes=3)


def record():
    return provenance.run_record(SETTINGS, "c0de", {"direct": "ab" * 32}, {"name": "local", "workers": 2})


def test_versions_machine_settings_zoo_and_commit_are_there():
    found = record()
    assert found["versions"]["numpy"] == metadata.version("numpy")
    assert found["versions"]["tab-marl"] == metadata.version("tab-marl")
    assert found["python"] == platform.python_version()
    assert found["machine"]["cores"] >= 1 and found["machine"]["processor"]
    assert found["settings"]["episodes"] == 3 and found["zoo"] == {"direct": "ab" * 32} and found["code"] == "c0de"
    head = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    if head.returncode == 0:
        assert re.fullmatch(re.escape(head.stdout.strip()) + r"(\+changes)?", found["commit"])


def test_nobody_is_named():
    text = json.dumps(record())
    for private in (str(Path.home()), "/home/", "somebody"):
        assert private not in text
    for name in (platform.node(), getpass.getuser()):
        assert not re.search(rf"\b{re.escape(name)}\b", text)


def test_a_run_is_kept_with_its_times_and_described(tmp_path, synthetic):
    with Store.create(tmp_path) as store:
        store.use("k", {}, {})
        first = store.begin_run("k", record())
        store.add("k", [(synthetic.row(), synthetic.timing())], first)
        store.end_run(first, "finished")
        second = store.begin_run("k", record())
        runs = store.runs("k")
    assert [(r.run, r.outcome, r.played) for r in runs] == [(first, "finished", 1), (second, None, 0)]
    assert (
        runs[0].started <= runs[0].ended
        and runs[1].ended is None
        and runs[0].record == json.loads(json.dumps(record()))
    )
    one, two = provenance.describe_runs(runs)
    assert one["episodes"] == "1" and "numpy " in one["versions"] and one["engine"] == "local (workers 2)"
    assert "killed" in two["ended"] and one["zoo"] == "direct abababababab"
    assert all(isinstance(value, str) for value in one.values())


def test_what_differs_between_machines_is_named():
    ours = provenance.identity("aaaa")
    assert provenance.differences(ours, dict(ours)) == ""
    theirs = ours | {"code": "bbbb", "numba": "0.1"}
    del theirs["scipy"]
    assert provenance.differences(ours, theirs) == (
        f"code bbbb instead of aaaa, scipy missing instead of {ours['scipy']}, numba 0.1 instead of {ours['numba']}"
    )
