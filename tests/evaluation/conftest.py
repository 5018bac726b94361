from pathlib import Path

import numpy as np
import pytest

from tab_marl.evaluation import settings
from tab_marl.evaluation.report import replay
from tab_marl.evaluation.report.page import ReportData, render
from tab_marl.evaluation.report.results import compute
from tab_marl.evaluation.units import Job, Unit
from tab_marl.world.scenario import Scenario


@pytest.fixture(scope="session")
def synthetic():
    """The module of made-up episodes, importable by spawned workers too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        import synthetic_rows

        yield synthetic_rows


def replays():
    trace = replay.Trace(10)
    trace.poses = [(0.5 + 0.05 * k, 1.0, 0.0, 2.0, 2.0 - 0.05 * k, 1.0, k > 5) for k in range(20)]
    trace.beliefs = [(k, np.eye(30)) for k in range(0, 20, 5)]
    trace.events = [(1.5, "intercepted")]
    episodes = [
        {
            "planner": p,
            "outcome": "met </script><script>alert(1)</script>",
            "note": "",
            "trace": replay.encode_trace(trace),
        }
        for p in ("S-POMCP", "TAB-POMCP")
    ]
    drawn = replay.encode_map(Scenario.preset("lab"))
    spread = np.zeros((30, 30))
    spread[10:20, 10:20] = 1.0
    field = {
        "rows": 30,
        "columns": 30,
        "frames": [[0, replay.encode_image(np.eye(30))], [5, replay.encode_image(spread)]],
    }
    about = {"about": "about", "why": "why", "map": drawn, "field": field, "episodes": episodes}
    return [{"title": "M1, point, episode 0", **about}, {"title": "M5, point, episode 3", **about}]


@pytest.fixture(scope="session")
def data(synthetic):
    """A page's worth of made-up episodes, one broken, with names that try to be markup."""
    chosen = settings.EvaluationSettings(missions=("M1", "M5"), families=("point", "ambiguous"), episodes=8)
    rows, timings = [], {}
    for mission in chosen.missions:
        for family in chosen.families:
            for seed in range(chosen.episodes):
                job = Job(Unit(mission, family, seed), chosen.planners, 1, None, ("direct", "<b>late</b>"), "default")
                for row, timing in synthetic.play(job):
                    rows.append(row)
                    timings[row.key] = timing
    broken = synthetic.row("MLE-POMCP", 99, error="ValueError: <script>alert(2)</script>", intercepted=False)
    rows.append(broken)
    return ReportData(
        rows, timings, {"seed": 1}, "abc123", replays(), {"map": "<svg></svg>", "map_text": "t"}, [], "1.0"
    )


@pytest.fixture(scope="session")
def results(data):
    """Every statistic of `data`."""
    return compute(data)


@pytest.fixture(scope="session")
def page(data, results):
    """The page of `data`."""
    return render(data, results)
