"""TorchRL's PPO on the single-agent view: collector, advantage module and loss as its own tutorial lays them out.

python scripts/examples/torchrl_ppo.py
"""

from __future__ import annotations

import torch
import typer
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, GymEnv, RewardSum, StepCounter, TransformedEnv, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import tab_marl  # noqa: F401, registers the environments


def make_env(mission: str, seed: int) -> TransformedEnv:
    env = TransformedEnv(GymEnv("tab_marl/Adversary-v0", mission=mission, opponent="static"))
    env.append_transform(StepCounter())
    env.append_transform(RewardSum())
    env.set_seed(seed)
    return env


def main(steps: int = 100_000, frames: int = 2048, epochs: int = 4, batch: int = 512, mission: str = "M4") -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    env = make_env(mission, 0)
    observed = env.observation_spec["observation"].shape[-1]
    body = nn.Sequential(
        MLP(in_features=observed, out_features=4, num_cells=[64, 64], activation_class=nn.Tanh), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(in_features=observed, out_features=1, num_cells=[64, 64], activation_class=nn.Tanh))
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.001, critic_coeff=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    collector = Collector(env, actor, frames_per_batch=frames, total_frames=steps, auto_register_policy_transforms=True)
    for number, data in enumerate(collector):
        advantage(data)
        flat = data.reshape(-1)
        for _ in range(epochs):
            for chosen in torch.randperm(len(flat)).split(batch):
                losses = loss(flat[chosen])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        returns = data["next", "episode_reward"][data["next", "done"]]
        if len(returns) and number % 5 == 0:
            print(f"{(number + 1) * frames:8,d} steps: {returns.mean():7.1f} reward per episode ({len(returns)} ended)")
    collector.shutdown()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        episode = make_env(mission, 1).rollout(2000, actor)
    print(
        f"one new episode without noise: {episode['next', 'episode_reward'][-1].item():.1f} reward, {len(episode)} steps"
    )


if __name__ == "__main__":
    typer.run(main)
