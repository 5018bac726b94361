"""What decides an episode, and in which order work comes."""

import numpy as np

from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.evaluation.units import Schedule, Unit, stable_hash, unit_seeds


def drain(schedule):
    jobs = []
    while (job := schedule.pop()) is not None:
        jobs.append(job)
    return jobs


def test_hash_is_the_same_everywhere():
    assert stable_hash("M1/point") == 0xD6332DCE  # printf M1/point | b2sum -l 32


def test_seeds_differ_by_every_coordinate():
    units = [Unit(m, f, s) for m in ("M1", "M2") for f in ("point", "ambiguous") for s in (0, 1)]
    seeds = set()
    for base in (0, 1):
        for unit in units:
            task, episode, planner = unit_seeds(base, unit)
            seeds |= {int(task.generate_state(1)[0]), episode, planner}
    assert len(seeds) == 2 * 8 * 3
    again = unit_seeds(0, units[0])
    assert again[1:] == unit_seeds(0, units[0])[1:]
    assert np.array_equal(again[0].generate_state(4), unit_seeds(0, units[0])[0].generate_state(4))


def test_planners_share_a_job_and_chains_wait():
    settings = EvaluationSettings(("M1", "M2"), ("point",), ("S-POMCP", "MLE-POMCP", "TAB-POMCP"), episodes=2)
    schedule = Schedule(settings, ("a", "b", "c"), [("M1", "point", "TAB-POMCP", 0), ("M2", "point", "MLE-POMCP", 0)])
    assert schedule.missing == 10
    starts = list(schedule.begin_chains())
    assert starts == [(Unit("M1", "point", 0), "MLE-POMCP"), (Unit("M2", "point", 1), "MLE-POMCP")]
    for unit, planner in starts:
        schedule.push_link(unit, planner, None)
    jobs = drain(schedule)
    assert [(j.unit.mission, j.unit.seed, j.planners) for j in jobs] == [
        ("M1", 0, ("MLE-POMCP",)),
        ("M1", 0, ("S-POMCP",)),
        ("M2", 0, ("S-POMCP", "TAB-POMCP")),
        ("M1", 1, ("S-POMCP", "TAB-POMCP")),
        ("M2", 1, ("MLE-POMCP",)),
        ("M2", 1, ("S-POMCP", "TAB-POMCP")),
    ]
    schedule.push_link(Unit("M1", "point", 1), "MLE-POMCP", "what was learned")
    (link,) = drain(schedule)
    assert link.learned == "what was learned" and link.is_link
    schedule.push_link(Unit("M1", "point", 2), "MLE-POMCP", "past the end")
    assert drain(schedule) == []


def test_adversaries_take_turns():
    schedule = Schedule(EvaluationSettings(("M1",), ("point",), ("random",), episodes=5), ("a", "b", "c"), [])
    assert [job.adversary for job in drain(schedule)] == ["a", "b", "c", "a", "b"]
