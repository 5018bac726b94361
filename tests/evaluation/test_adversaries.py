"""Which adversaries a table plays: names, folders, splits of the zoo, and that splits are not mixed unasked."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tab_marl.agents import planners
from tab_marl.agents.policies.zoo import SHIPPED, ZOO_VARIABLE, find_policy, load_policy, load_zoo
from tab_marl.evaluation.adversaries import digest, opponent, population, precedents, resolve_opponents, zoo_names
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.evaluate import prepare
from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.mission.tasks import sample_task


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A user's zoo with one policy of each split."""
    monkeypatch.setenv(ZOO_VARIABLE, str(tmp_path))
    for split, name in (("development", "my-dev"), ("final", "my-final")):
        shutil.copytree(SHIPPED / zoo_names(split)[0], tmp_path / name)
        card = tmp_path / name / "card.json"
        card.write_text(card.read_text().replace(f'"name": "{zoo_names(split)[0]}"', f'"name": "{name}"', 1))
    return tmp_path


def test_the_final_split_plays_unless_others_are_named():
    assert tuple(resolve_opponents(())) == zoo_names("final") == tuple(resolve_opponents(("final",)))
    assert tuple(resolve_opponents(("development", "scripted"))) == (*zoo_names("development"), "scripted")
    assert set(zoo_names()) == set(zoo_names("final")) | set(zoo_names("development"))
    assert not set(zoo_names("final")) & set(zoo_names("development"))


def test_names_are_forgiving_and_unknown_ones_answered(tmp_path):
    name = zoo_names("final")[0]
    assert list(resolve_opponents((name.upper(), "scripted"))) == [name, "scripted"]
    assert opponent("scripted").name == "scripted"
    with pytest.raises(UserError, match="no adversary named 'nobody'"):
        resolve_opponents(("nobody",))
    with pytest.raises(ValueError, match=r"card\.json"):
        resolve_opponents((str(tmp_path),))


def test_splits_are_not_mixed_silently():
    """The error names who is of which split; the option that allows it is part of the settings and of their key."""
    dev, final = zoo_names("development")[0], zoo_names("final")[0]
    for asked in ((dev, final), ("all",), (str(SHIPPED / dev), "final")):
        with pytest.raises(UserError, match=rf"for development \({dev}.*final table \(.*{final}.*--mix-splits"):
            resolve_opponents(asked)
        assert len(resolve_opponents(asked, mix_splits=True)) >= 2
    with pytest.raises(UserError, match="--mix-splits"):
        prepare(EvaluationSettings(adversaries=(dev, final)))
    mixed = prepare(EvaluationSettings(adversaries=(dev, final), mix_splits=True))
    assert mixed.adversaries == (dev, final) and mixed.content["mix_splits"] is True
    apart = prepare(EvaluationSettings(adversaries=(dev,)))
    assert "mix_splits" not in apart.content and apart.key != mixed.key


def test_a_users_policies_go_by_name_and_count_in_the_key(own):
    found = resolve_opponents(("my-final", "final"))
    assert list(found) == [str(own / "my-final"), *zoo_names("final")]
    assert found[str(own / "my-final")] == digest(find_policy("my-final"))
    assert "my-final" not in resolve_opponents(()), "a table's adversaries do not change with a user's folder"
    with pytest.raises(UserError, match=r"for development \(my-dev\)"):
        resolve_opponents(("my-dev", "final"))


def test_rows_of_a_users_policy_in_another_style_do_not_mix(own):
    """The same weights that are shown other routes are another adversary; what was measured of it is not."""
    card = own / "my-final" / "card.json"
    settings = EvaluationSettings(adversaries=("my-final",))
    before, written = prepare(settings).key, json.loads(card.read_text())
    card.write_text(json.dumps({**written, "description": "mine", "success": []}))
    assert prepare(settings).key == before
    card.write_text(json.dumps({**written, "style": {**written["style"], "side": 0.5}}))
    assert prepare(settings).key != before


def test_population_pomcp_knows_the_policies_that_are_played():
    """Their trajectories and nobody else's."""
    task = sample_task(np.random.default_rng(6), "M4")
    names = zoo_names("final")[:2]
    positions, completed = population(names)(task, np.random.default_rng(0))
    assert len(positions) == len(completed) == 60
    alone, _ = population(names[:1])(task, np.random.default_rng(0))
    np.testing.assert_array_equal(positions[:30], alone)
    assert {p.name for p in load_zoo()} > set(names)


def test_every_caller_has_a_recurrent_policy_with_a_memory_of_its_own() -> None:
    """population-POMCP rolls out the policy that it plays against, many episodes at a time, in the middle of an episode."""
    playing, alone = opponent("fickle-lstm"), load_policy(SHIPPED / "fickle-lstm")
    task = sample_task(np.random.default_rng(3), "M1", "ambiguous")
    observations = np.random.default_rng(4).uniform(-1, 1, (6, playing.actor.network.layers[0])).astype(np.float32)
    for step, observation in enumerate(observations):
        if step == 3:
            population(["fickle-lstm"])(task, np.random.default_rng(5))
        np.testing.assert_array_equal(playing.act(observation), alone.act(observation))


def test_precedents_are_never_of_the_policy_that_is_played():
    """TAB-POMCP+precedents is shown the development policies, less the one it plays, by whatever name it was asked for."""
    task = sample_task(np.random.default_rng(6), "M1")
    development = zoo_names("development")
    played = development[0]
    of_others, _ = population(development[1:])(task, np.random.default_rng(0))
    for called in (played, str(SHIPPED / played)):
        np.testing.assert_array_equal(precedents(called)(task, np.random.default_rng(0))[0], of_others)
    for called in (zoo_names("final")[0], "scripted"):
        shown, _ = precedents(called)(task, np.random.default_rng(0))
        np.testing.assert_array_equal(shown, population(development)(task, np.random.default_rng(0))[0])
    unchosen, _ = planners.zoo_rollouts("development")(task, np.random.default_rng(0))
    np.testing.assert_array_equal(unchosen, shown)
