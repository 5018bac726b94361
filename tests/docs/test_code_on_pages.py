"""The code on the pages of the environments runs, as a reader would paste it, with little learning."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent.parent / "docs" / "environments"
PAGES = ("training.md", "batched.md", "rendering.md")
BLOCKS = [
    (f"{name}-{i}", block)
    for name in PAGES
    for i, block in enumerate(re.findall(r"```python\n(.*?)```", (FOLDER / name).read_text(), flags=re.DOTALL))
]


def test_there_is_code() -> None:
    assert len(BLOCKS) >= 8


@pytest.mark.parametrize(("name", "block"), BLOCKS, ids=[name for name, _ in BLOCKS])
def test_code(name: str, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if "PPO.load" in block:
        from stable_baselines3 import PPO

        import tab_marl  # noqa: F401, registers the environments

        PPO("MlpPolicy", "tab_marl/Adversary-M4-v0", n_steps=8, batch_size=8, device="cpu").save("adversary.zip")
    names: dict[str, object] = {}
    small = re.sub(r"model\.learn\([\d_]+\)", "model.learn(64)", block).replace("n_steps=256", "n_steps=8")
    small = small.replace("batch_size=1024", "batch_size=16").replace("n_envs=8", "n_envs=2")
    exec(compile(small, name, "exec"), names)  # noqa: S102, our own page
    if "picture" in names:
        assert np.asarray(names["picture"]).shape == (720, 1040, 3)
