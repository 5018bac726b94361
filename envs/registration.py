"""Names for the environments in Gymnasium's and PettingZoo's registries. Entry points are strings: nothing is loaded."""

from __future__ import annotations

GYMNASIUM_IDS = {
    "tab_marl/Ego-v0": "tab_marl.envs.single_agent:ego_env",
    "tab_marl/Adversary-v0": "tab_marl.envs.single_agent:adversary_env",
}
BATCHED_IDS = {
    "tab_marl/BatchedEgo-v0": "tab_marl.envs.batched_env:batched_ego_env",
    "tab_marl/BatchedAdversary-v0": "tab_marl.envs.batched_env:batched_adversary_env",
}
"""For `gymnasium.make_vec` only."""
PETTINGZOO_ID = "tab_marl/intercept-v0"
PETTINGZOO_ENTRY_POINTS = {
    "parallel": "tab_marl.envs.intercept_v0:parallel_env",
    "aec": "tab_marl.envs.intercept_v0:env",
}


def register_all() -> None:
    """Register every environment with both libraries; those already registered are left alone."""
    import gymnasium
    import pettingzoo

    for name, entry_point in GYMNASIUM_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point)
    for name, entry_point in BATCHED_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, vector_entry_point=entry_point)
    registries = {"parallel": pettingzoo.parallel_registry, "aec": pettingzoo.aec_registry}
    for kind, entry_point in PETTINGZOO_ENTRY_POINTS.items():
        if PETTINGZOO_ID not in registries[kind]:
            pettingzoo.register(kind, PETTINGZOO_ID, entry_point)
