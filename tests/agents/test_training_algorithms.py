"""The six algorithms: each trains, continues after a kill to the same weights, and takes its hyperparameters from its file."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tab_marl.agents.policies.actor import Memory
from tab_marl.agents.policies.zoo import export_policy, load_policy
from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.checkpoint import CHECKPOINT_FILE, REPLAY_FOLDER
from tab_marl.agents.training.env import TRAINING, BatchedVecEnv, build_bank, difficulties
from tab_marl.agents.training.hyperparameters import (
    BATCHED_MISSIONS,
    FILES,
    HUNTED_MISSIONS,
    HyperparameterError,
    check,
    packaged,
    read_policy_kwargs,
    schedule,
    write_policy_kwargs,
)
from tab_marl.agents.training.initial import begin_with
from tab_marl.agents.training.log import LearningLog, read_log
from tab_marl.agents.training.settings import TrainingError, TrainingSettings
from tab_marl.agents.training.train import LOG_FILE, Sampler, build_model, train, training_tasks
from tab_marl.envs.styles import Style

ROBOTS = 8
ON_POLICY = {"n_steps": 10}
OFF_POLICY = {"batch_size": 16, "learning_starts": 80, "buffer_size": 160}
"""The ring of 20 transitions is overwritten several times."""
CHANGES = {
    "ppo": {**ON_POLICY, "batch_size": 40, "n_epochs": 2},
    "ppo_lstm": {**ON_POLICY, "batch_size": 40, "n_epochs": 2},
    "a2c": ON_POLICY,
    "sac": OFF_POLICY,
    "td3": OFF_POLICY,
    "tqc": OFF_POLICY,
}


def settings_of(algorithm: str, **changes) -> TrainingSettings:
    given = {
        "name": algorithm, "algorithm": algorithm, "missions": ("M1",), "families": ("point",), "tasks": 2,
        "robots": ROBOTS, "layers": (16,), "lstm_units": 8 if algorithm == "ppo_lstm" else 0, "steps": 60 * ROBOTS,
        "final_share": 0.3, "checkpoint_seconds": 1e-6, "hyperparameters": CHANGES[algorithm],
    }  # fmt: skip
    return TrainingSettings(**{**given, **changes})


class Stop(Exception):
    """Ends a run from its progress callback, as a kill would: nothing after the last checkpoint is kept."""


def stop_after(steps: int):
    def tell(stand):
        if stand.phase == "training" and stand.done >= steps:
            raise Stop

    return tell


def logged(folder: Path) -> list[list[str]]:
    """Rows of the log without the clock."""
    with (folder / LOG_FILE).open(newline="") as file:
        return [row[:2] + row[4:] for row in csv.reader(file)]


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_an_interrupted_run_ends_with_the_weights_of_an_undisturbed_one(tmp_path, algorithm):
    """Interrupted twice: before and in the final phase. The log has no row twice and none too few."""
    settings = settings_of(algorithm)
    expected = train(settings, tmp_path / "undisturbed")
    broken = tmp_path / "broken"
    for after in (25 * ROBOTS, 50 * ROBOTS):
        with pytest.raises(Stop):
            train(settings, broken, stop_after(after))
    if not ALGORITHMS[algorithm].on_policy:
        assert list((broken / REPLAY_FOLDER).glob("*.pt"))
    began = []
    model = train(settings, broken, lambda stand: began.append(stand.done) if stand.phase == "training" else None)
    assert began[0] > 40 * ROBOTS, "it began anew instead of continuing"
    theirs = expected.policy.state_dict()
    for name, tensor in model.policy.state_dict().items():
        assert torch.equal(tensor, theirs[name]), name
    assert logged(broken) == logged(tmp_path / "undisturbed")
    assert not (broken / REPLAY_FOLDER).exists(), "a finished run needs no replay files"
    # The policy that the zoo exports computes what the model does.
    policy = load_policy(export_policy(model, settings, broken, "anew"))
    observation = np.random.default_rng(0).uniform(0, 1, (5, 40)).astype(np.float32)
    if algorithm != "ppo_lstm":
        assert np.allclose(
            policy.actor(observation, Memory()), model.predict(observation, deterministic=True)[0], atol=1e-5
        )
    assert policy.card.command == "anew" and policy.card.algorithm.startswith(ALGORITHMS[algorithm].title)


def test_a_replay_file_that_is_missing_is_noticed(tmp_path):
    settings = settings_of("td3")
    with pytest.raises(Stop):
        train(settings, tmp_path, stop_after(30 * ROBOTS))
    for path in (tmp_path / REPLAY_FOLDER).glob("*.pt"):
        path.unlink()
    with pytest.raises(TrainingError, match=r"holds 0 transitions, the checkpoint \d+: delete"):
        train(settings, tmp_path)


def test_two_processes_cannot_train_in_one_folder(tmp_path):
    """The second is refused while the first is at work, and may go on when that has ended."""
    settings = settings_of("a2c", steps=20 * ROBOTS)
    refused = []

    def again(stand):
        with pytest.raises(TrainingError, match="another process trains in") as caught:
            train(settings, tmp_path)
        refused.append(caught.value)

    train(settings, tmp_path, again)
    assert refused
    train(settings, tmp_path)


def test_the_log_has_a_row_per_update(tmp_path):
    settings = settings_of("a2c")
    train(settings, tmp_path)
    curve = read_log(tmp_path)
    assert curve.steps.tolist() == [10 * ROBOTS * (i + 1) for i in range(6)]
    assert (np.diff(curve.cpu_seconds) >= 0).all() and curve.cpu_seconds[0] > 0
    assert set(curve.success) == {"M1"} and len(curve.reward) == 6
    header = (tmp_path / LOG_FILE).read_text().splitlines()[0]
    assert header == "steps,updates,seconds,cpu_seconds,reward,success_M1"


def test_rows_after_the_checkpoint_and_half_rows_are_dropped_on_continuing(tmp_path):
    log = LearningLog(tmp_path, ["M1"], 0)
    for steps in (10, 20, 30):
        log.row(steps, steps, 1.0, 2.0, math.nan, {"M1": 0.5})
    with (tmp_path / LOG_FILE).open("a") as file:
        file.write("40,4")
    LearningLog(tmp_path, ["M1"], 20)
    curve = read_log(tmp_path)
    assert curve.steps.tolist() == [10, 20] and curve.success["M1"].tolist() == [0.5, 0.5]
    assert np.isnan(curve.reward).all()
    (tmp_path / LOG_FILE).write_text("a,b\n")
    with pytest.raises(ValueError, match="is no log of a training run"):
        read_log(tmp_path)


def small_env(settings: TrainingSettings) -> BatchedVecEnv:
    tasks = training_tasks(settings)
    return BatchedVecEnv(build_bank(tasks, Style(), 0), [t.mission_id for t in tasks], settings.robots, 0)


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_hyperparameters_are_read_as_rl_zoo3_reads_them(algorithm, tmp_path):
    """The keyword arguments that rl-baselines3-zoo's own ExperimentManager makes of the file are those of our models."""
    from argparse import Namespace

    import gymnasium
    from rl_zoo3.exp_manager import ExperimentManager

    gymnasium.register(BATCHED_MISSIONS, entry_point="nowhere:Nothing")  # rl_zoo3 asks what an id is before it reads
    try:
        manager = ExperimentManager(
            Namespace(), algorithm, BATCHED_MISSIONS, str(tmp_path), config=str(FILES / f"{algorithm}.yml"), verbose=0
        )
        unprocessed, saved = manager.read_hyperparameters()
        theirs = manager._preprocess_action_noise(
            manager._preprocess_hyperparams(unprocessed)[0], saved, small_env(settings_of(algorithm, robots=2))
        )
    finally:
        del gymnasium.registry[BATCHED_MISSIONS]
    settings = TrainingSettings(algorithm=algorithm, tasks=2, missions=("M1",), families=("point",))
    assert (settings.steps, settings.robots) == (manager.n_timesteps, manager.n_envs)
    model = build_model(settings, small_env(settings))
    assert type(model).__name__ == ALGORITHMS[algorithm].title
    for name, value in theirs.items():
        if name in ("policy", "ent_coef", "top_quantiles_to_drop_per_net"):
            continue
        if name == "policy_kwargs":
            mine = {k: v for k, v in model.policy_kwargs.items() if k in value}
            assert mine == value
        elif name == "action_noise":
            assert (model.action_noise.std * np.ones(2) == value._sigma).all()
        elif callable(value):
            own = getattr(model, "lr_schedule" if name == "learning_rate" else name)
            assert [own(p) for p in (1.0, 0.4, 0.0)] == pytest.approx([value(p) for p in (1.0, 0.4, 0.0)])
        elif name != "train_freq":
            assert getattr(model, name) == value, name
    model.env.close()


def test_the_files_hold_every_algorithm_and_nothing_that_our_training_refuses():
    assert {path.stem for path in FILES.glob("*.yml")} == set(ALGORITHMS)
    for algorithm in ALGORITHMS:
        held = yaml.safe_load((FILES / f"{algorithm}.yml").read_text())
        assert BATCHED_MISSIONS in held
        check(algorithm, TrainingSettings(algorithm=algorithm).hyperparameters)
        assert packaged(algorithm, HUNTED_MISSIONS).keys()


@pytest.mark.parametrize(
    "text", ["dict(net_arch=[64, 32], activation_fn=nn.ReLU)", "dict(net_arch=dict(pi=[8], qf=[16]))"]
)
def test_policy_kwargs_are_read_without_eval_and_written_back(text):
    from torch import nn

    read = read_policy_kwargs(text)
    evaluated = eval(text, {"nn": nn, "dict": dict})
    named = {k: getattr(nn, v.removeprefix("nn.")) if isinstance(v, str) else v for k, v in read.items()}
    assert named == evaluated
    assert read_policy_kwargs(write_policy_kwargs(read)) == read


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "dict(net_arch=open('x'))", "dict(**{})", "dict([1])", "dict(a=nn.Linear)",
        "dict(a=(lambda: 1)())", "[1]", "dict(", "dict(a=" + "[" * 300 + "]" * 300 + ")", "nn.Tanh.__class__",
    ],
)  # fmt: skip
def test_policy_kwargs_that_would_run_code_are_refused(text):
    with pytest.raises(HyperparameterError) as caught:
        read_policy_kwargs(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("algorithm", "changes", "said"),
    [
        ("sac", {"learning_rat": 1e-3}, "SAC has no hyperparameter 'learning_rat': did you mean 'learning_rate'"),
        ("ppo", {"learning_rate": "cos_1e-3"}, "must be a number or lin_NUMBER"),
        ("ppo", {"use_sde": True}, "could not be continued"),
        ("ppo", {"gamma": 1.5}, "gamma is 1.5, must lie in 0..1"),
        ("ppo", {"n_epochs": 0}, "n_epochs is 0, must be >= 1"),
        ("td3", {"noise_type": "ornstein-uhlenbeck"}, "must be 'normal'"),
        ("a2c", {"normalize": True}, "cannot be set"),
    ],
)
def test_hyperparameters_that_are_wrong_are_refused_in_one_line(tmp_path, algorithm, changes, said):
    settings = settings_of(algorithm, hyperparameters={**CHANGES[algorithm], **changes})
    with pytest.raises(TrainingError, match=said) as caught:
        train(settings, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_linear_schedule_ends_at_zero():
    falls = schedule("lin_5e-4", "learning_rate")
    assert [falls(p) for p in (1.0, 0.5, 0.0)] == pytest.approx([5e-4, 2.5e-4, 0.0])


def test_settings_take_layers_activation_and_units_over_the_files():
    settings = TrainingSettings(algorithm="ppo_lstm", layers=(32, 16), activation="relu", lstm_units=24)
    policy = read_policy_kwargs(settings.hyperparameters["policy_kwargs"])
    assert policy["net_arch"] == [32, 16] and policy["activation_fn"] == "nn.ReLU" and policy["lstm_hidden_size"] == 24
    assert replace(settings, seed=3).hyperparameters == settings.hyperparameters
    usual = TrainingSettings(algorithm="sac")
    assert usual.activation == "relu" and usual.layers == (128, 128) and usual.steps > 0


def test_the_curriculum_lets_harder_tasks_in_as_the_run_goes_on():
    settings = settings_of("a2c", difficulty=(0.2, 0.8), curriculum_share=0.5, tasks=12)
    hard = np.array(difficulties(TRAINING, settings.seed, 12, (0.2, 0.8)))
    assert (hard >= 0.2).all() and (hard <= 0.8).all() and len(set(hard)) == 12
    sampler = Sampler(settings, ("M1",) * 12)
    begin, middle, end = (sampler(int(share * settings.steps)) for share in (0.0, 0.25, 0.5))
    assert (begin > 0).sum() == 1 and np.argmax(begin) == np.argmin(hard)
    assert ((middle > 0) == (hard <= 0.5)).all() and (end > 0).all()
    assert all(weights.sum() == pytest.approx(1.0) for weights in (begin, middle, end))
    final = Sampler(settings, ("M1", "M2") * 6)(settings.steps)
    assert final[1] == pytest.approx(2 * final[0])
    slacks = [task.slack for task in training_tasks(settings)]
    assert np.argmax(slacks) == np.argmin(hard)  # the easiest task leaves the most time


def test_compositions_are_trained_on_when_asked_for():
    settings = settings_of("a2c", compositions=("chain",), tasks=4)
    tasks = training_tasks(settings)
    assert [task.mission_id for task in tasks] == ["M1", "sampled", "M1", "sampled"]
    assert tasks[1].mission.name == "chain"


@pytest.mark.parametrize("algorithm", ["ppo", "td3"])
def test_a_run_can_begin_with_a_policy_of_the_same_network(tmp_path, algorithm):
    first = settings_of(algorithm, steps=ROBOTS * 20)
    model = train(first, tmp_path / "first")
    folder = export_policy(model, first, tmp_path / "first")
    for initial in (str(folder), str(tmp_path / "first")):
        env = small_env(first)
        again = build_model(first, env)
        begin_with(again, initial)
        observation = env.reset()
        assert np.allclose(
            again.predict(observation, deterministic=True)[0],
            model.predict(observation, deterministic=True)[0],
            atol=1e-6,
        )
    with pytest.raises(TrainingError, match="cannot begin with"):
        train(settings_of(algorithm, layers=(24,), initial=str(folder)), tmp_path / "second")
    assert not (tmp_path / "second" / CHECKPOINT_FILE).exists()
