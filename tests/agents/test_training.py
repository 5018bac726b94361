"""Training: settings, resuming after a kill, and that it learns."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from tab_marl.agents.training.env import HELD_OUT, TRAINING, BatchedVecEnv, build_bank, draw_tasks
from tab_marl.agents.training.settings import TrainingError, TrainingSettings
from tab_marl.agents.training.train import CHECKPOINT_FILE, LOG_FOLDER, train
from tab_marl.envs.styles import STYLES, Style
from tab_marl.world.scenario import UnknownName

SMALL = TrainingSettings(
    name="small", missions=("M1",), families=("point",), tasks=4, robots=8,
    hyperparameters={"n_steps": 32, "batch_size": 128, "n_epochs": 2},
    layers=(16,), steps=8 * 32 * 12, final_share=0.3, checkpoint_seconds=0.001,
)  # fmt: skip


def weights(model):
    return {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}


def assert_same(one, two):
    assert one.keys() == two.keys()
    for name in one:
        assert torch.equal(one[name], two[name]), name


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    stands = []
    model = train(SMALL, folder, stands.append)
    return folder, weights(model), stands


def test_a_run_writes_settings_log_and_checkpoint_and_reports_progress(undisturbed):
    folder, _, stands = undisturbed
    assert TrainingSettings.from_toml(folder / "settings.toml") == SMALL
    assert (folder / CHECKPOINT_FILE).stat().st_size > 1000
    assert list((folder / LOG_FOLDER).glob("events.out.tfevents.*"))
    assert next(s.phase for s in stands) == "tasks"
    training = [s for s in stands if s.phase == "training"]
    assert [s.done for s in training] == [8 * 32 * (i + 1) for i in range(12)]
    assert all(s.total == SMALL.steps and s.steps_per_second > 0 and set(s.success) == {"M1"} for s in training)


def test_tensorboard_holds_success_and_reward(undisturbed):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder, _, _ = undisturbed
    events = EventAccumulator(str(folder / LOG_FOLDER))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"success/M1", "rollout/ep_rew_mean", "train/loss"} <= set(tags)
    # The last update is written when the next rollout ends, as stable-baselines3 does.
    assert events.Scalars("train/loss")[-1].step >= SMALL.steps - 8 * 32


def test_the_same_settings_give_the_same_weights(undisturbed, tmp_path):
    _, expected, _ = undisturbed
    assert_same(weights(train(SMALL, tmp_path)), expected)


class Stop(Exception):
    """Ends a run from its progress callback."""


@pytest.mark.parametrize("after", [3, 10])
def test_an_interrupted_run_continues_to_the_same_weights(undisturbed, tmp_path, after):
    """Also when the interruption falls into the final phase."""
    _, expected, _ = undisturbed

    def interrupt(stand):
        if stand.phase == "training" and stand.done >= after * 8 * 32:
            raise Stop

    with pytest.raises(Stop):
        train(SMALL, tmp_path, interrupt)
    steps = []
    model = train(SMALL, tmp_path, lambda stand: steps.append(stand.done) if stand.phase == "training" else None)
    assert steps[0] > 8 * 32, "it began anew instead of continuing"
    assert_same(weights(model), expected)


def test_a_killed_process_continues_to_the_same_weights(undisturbed, tmp_path):
    """kill -9 at some moment after the first checkpoint; the folder stays usable and the result is the same."""
    _, expected, _ = undisturbed
    settings = tmp_path / "wanted.toml"
    settings.write_text(SMALL.to_toml())
    run = tmp_path / "run"
    program = (
        "import sys, time\n"
        "from tab_marl.agents.training.train import train\n"
        "from tab_marl.agents.training.settings import TrainingSettings\n"
        "pause = lambda stand: time.sleep(0.2 if stand.phase == 'training' else 0)\n"
        "train(TrainingSettings.from_toml(sys.argv[1]), sys.argv[2], pause)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program, str(settings), str(run)])
    try:
        deadline = time.monotonic() + 120
        while not (run / CHECKPOINT_FILE).exists() and time.monotonic() < deadline:
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.01)
        time.sleep(0.3)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert torch.load(run / CHECKPOINT_FILE, weights_only=True)["steps"] < SMALL.steps
    assert_same(weights(train(SMALL, run)), expected)


def test_a_finished_run_is_only_read(undisturbed):
    folder, expected, _ = undisturbed
    stands = []
    model = train(SMALL, folder, stands.append)
    assert {s.phase for s in stands} == {"tasks"}
    assert_same(weights(model), expected)


def test_another_run_in_the_folder_is_refused(undisturbed):
    folder, _, _ = undisturbed
    with pytest.raises(TrainingError, match=r"holds a run with seed = 0, asked for 3: continue it"):
        train(replace(SMALL, seed=3), folder)
    train(replace(SMALL, checkpoint_seconds=99.0), folder)  # how often to save is not part of the run


def test_a_damaged_checkpoint_is_refused_in_one_line(undisturbed, tmp_path):
    folder, _, _ = undisturbed
    (tmp_path / "settings.toml").write_bytes((folder / "settings.toml").read_bytes())
    (tmp_path / CHECKPOINT_FILE).write_bytes((folder / CHECKPOINT_FILE).read_bytes()[:5000])
    with pytest.raises(TrainingError, match=r"cannot read the checkpoint .*delete it") as caught:
        train(SMALL, tmp_path)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_that_would_run_code_is_refused(undisturbed, tmp_path):
    import pickle

    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "sprung"),))

    folder, _, _ = undisturbed
    (tmp_path / "settings.toml").write_bytes((folder / "settings.toml").read_bytes())
    (tmp_path / CHECKPOINT_FILE).write_bytes(pickle.dumps(Trap()))
    with pytest.raises(TrainingError, match="cannot read the checkpoint"):
        train(SMALL, tmp_path)
    assert not (tmp_path / "sprung").exists()


def test_a_folder_that_cannot_be_made_is_an_os_error_with_its_name(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        train(SMALL, tmp_path / "file" / "run")


@pytest.mark.parametrize("style", list(STYLES))
def test_settings_round_trip(tmp_path, style):
    settings = TrainingSettings.for_style(style, seed=7, layers=(32, 16))
    path = tmp_path / "settings.toml"
    path.write_text(settings.to_toml())
    assert TrainingSettings.from_toml(path) == settings


def test_toml_may_name_a_style_and_leave_the_rest(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text('name = "mine"\nstyle = "via"\nsteps = 5000\n')
    assert TrainingSettings.from_toml(path) == TrainingSettings(name="mine", style=STYLES["via"], steps=5000)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("steps = -1", "steps is -1, must be >= 1"),
        ("stepz = 5", "stepz"),
        ('steps = "many"', "steps"),
        ('style = "viaa"', "did you mean 'via'"),
        ('missions = ["M9"]', "M9"),
        ('name = "a/b"', "usable as a folder's name"),
        ("steps = ", "cannot read training settings"),
        ("[style]\nside = 3.0", "side is 3.0"),
        ("final_share = 1.5", "final_share is 1.5, must lie in 0..1"),
        ('algorithm = "sacc"', "did you mean 'sac'"),
        ('activation = "gelu"', "gelu"),
        ("lstm_units = 8", "ppo has no LSTM"),
        ("difficulty = [0.9, 0.1]", "must be 0 <= easiest <= hardest <= 1"),
        ("curriculum_share = 0.5", "needs difficulty"),
        ('[hyperparameters]\npolicy_kwargs = "__import__(1)"', "calls something other than dict"),
    ],
)
def test_bad_settings_are_refused_in_one_line(tmp_path, text, said):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(TrainingError, match=said) as caught:
        TrainingSettings.from_toml(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_unknown_names_are_answered_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'camera-shy'"):
        TrainingSettings.for_style("camerashy")


def test_training_and_held_out_tasks_share_nothing_and_depend_on_their_number_only():
    one = draw_tasks(TRAINING, 0, 4, ("M1", "M3"), ("point",))
    assert one[:2] == draw_tasks(TRAINING, 0, 2, ("M1", "M3"), ("point",))
    assert [t.mission_id for t in one] == ["M1", "M3", "M1", "M3"]
    other = draw_tasks(HELD_OUT, 0, 4, ("M1", "M3"), ("point",))
    assert all(a.scenario != b.scenario for a in one for b in other)


def test_the_vector_environment_keeps_stable_baselines3s_rules():
    tasks = draw_tasks(TRAINING, 1, 3, ("M1",), ("point",))
    env = BatchedVecEnv(build_bank(tasks, Style(), 0), ["M1"] * 3, 6, 0)
    first = env.reset()
    assert first.shape == (6, *env.observation_space.shape) and first.dtype == np.float32
    ended = 0
    for _ in range(700):
        before = env.world.observation.copy()
        env.step_async(np.tile(np.array([[1.0, 0.3]], dtype=np.float32), (6, 1)))
        observation, reward, done, infos = env.step_wait()
        assert observation is not env.world.observation and not np.shares_memory(observation, env.world.observation)
        assert reward.dtype == np.float32 and len(infos) == 6
        for i in np.flatnonzero(done):
            ended += 1
            assert infos[i]["terminal_observation"].shape == env.observation_space.shape
            assert infos[i]["episode"]["l"] >= 1
            assert env.world.clocks[i, 0] == 0, "a new episode has begun"
        assert all("episode" not in infos[i] for i in np.flatnonzero(~done))
        assert before.shape == observation.shape
    assert ended >= 6
    assert 0 <= env.success()["M1"] <= 1


def test_a_quarter_of_a_minute_of_training_learns_to_reach_a_checkpoint(tmp_path):
    """From nothing to half of the missions of one type on a few maps."""
    settings = TrainingSettings(
        name="quick", missions=("M1",), families=("point",), tasks=12, steps=60_000, robots=32,
        layers=(32, 32), hyperparameters={"n_steps": 64, "batch_size": 1024, "learning_rate": 1e-3}, checkpoint_seconds=1e6,
    )  # fmt: skip
    stands = []
    train(settings, tmp_path, stands.append)
    training = [s for s in stands if s.phase == "training"]
    assert not training[0].success["M1"] > 0.2
    assert training[-1].success["M1"] >= 0.5
