"""Settings: every mistake is one line that names the field; the key changes with what decides a row, and with nothing else."""

import dataclasses

import pytest

from tab_marl.evaluation import settings
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.settings import EvaluationSettings, build_settings, settings_key


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("episodes = 'many'", r"episodes: .*integer.*'many'"),
        ("episodes = 0", "episodes is 0, must be >= 1"),
        ("episode = 3", "episode: there is no such setting"),
        ("planners = ['TAB-PONCP']", "did you mean 'TAB-POMCP'"),
        ("planners = []", "planners is empty"),
        ("missions = ['M1', 'M1']", "M1 is named twice"),
        ("families = ['points']", "did you mean 'point'"),
        ("slack = 0.5", r"slack is 0.5, must lie in \(1, 100\]"),
        ("slack = nan", r"slack is nan"),
        ("planner_preset = 'papr'", r"planner_preset: .*'paper'"),
        ("workers = 0", "workers is 0"),
        ("episodes = ", "not valid TOML"),
        ("seed = -1", "seed is -1"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, text, message):
    path = tmp_path / "evaluation.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        build_settings(config=path)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        build_settings(config=tmp_path / "none.toml")
    with pytest.raises(UserError, match="cannot be read"):
        build_settings(config=tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not valid TOML"):
        build_settings(config=tmp_path / "binary.toml")


def test_preset_then_file_then_command_line(tmp_path):
    path = tmp_path / "e.toml"
    path.write_text("episodes = 7\nseed = 3\nplanners = ['tab-pomcp', 'Random']")
    found = build_settings("demo", path, {"seed": 4, "missions": None})
    assert (found.episodes, found.seed, found.planners) == (7, 4, ("TAB-POMCP", "random"))
    assert found.families == ("point", "ambiguous")  # the preset's, which neither changed


def test_key_follows_what_decides_a_row():
    base = EvaluationSettings()

    def key(changed, code="c", adversaries=("a",)):
        return settings_key(changed.content(code, adversaries))

    same = dataclasses.replace(base, episodes=3, missions=("M1",), planners=("random",), workers=9, replays=0)
    assert key(base) == key(same)
    different = [
        key(dataclasses.replace(base, seed=1)),
        key(dataclasses.replace(base, slack=1.5)),
        key(dataclasses.replace(base, planner_preset="paper")),
        key(base, code="d"),
        key(base, adversaries=("a", "b")),
    ]
    assert len({key(base), *different}) == 6


def test_code_counts_but_comments_do_not(tmp_path):
    path = tmp_path / "m.py"

    def meaning(text):
        path.write_text(text)
        return settings._meaning(path)

    first = meaning('"""Doc."""\nx = 1\n\n\ndef f():\n    """Doc."""\n    return x\n')
    assert first == meaning("# a comment\nx = 1\ndef f():\n\n    return x\n")
    assert first != meaning("x = 2\ndef f():\n    return x\n")
