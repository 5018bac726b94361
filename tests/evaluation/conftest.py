from pathlib import Path

import pytest


@pytest.fixture
def synthetic(monkeypatch):
    """The module of made-up episodes, importable by spawned workers too."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import synthetic_rows

    return synthetic_rows
