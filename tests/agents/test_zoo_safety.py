"""Files of policies are hostile until shown otherwise: nothing in them runs, nothing in them is unbounded."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from stable_baselines3 import PPO

from tab_marl.agents.policies import sb3_actors, zoo
from tab_marl.agents.policies.joining import Joining, join, read_model
from tab_marl.agents.policies.zoo import (
    CARD_FILE,
    SHIPPED,
    WEIGHTS_FILE,
    PolicyError,
    find_policy,
    load_policy,
    load_zoo,
)
from tab_marl.envs.single_agent import adversary_env
from tab_marl.world.scenario import UnknownName


class Trap:
    """Makes a folder when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        import os

        return (os.mkdir, (str(self.path),))


@pytest.fixture(scope="module")
def model_zip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.zip"
    PPO("MlpPolicy", adversary_env(), device="cpu", policy_kwargs={"net_arch": [4]}).save(path)
    return path


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of a shipped policy that may be damaged."""
    shutil.copytree(SHIPPED / "direct", tmp_path / "direct")
    return tmp_path / "direct"


def changed_zip(source: Path, target: Path, **members: bytes) -> Path:
    """The zip with other content in some members ("policy_pth" stands for policy.pth)."""
    new = {name.replace("_", "."): content for name, content in members.items()}
    with zipfile.ZipFile(source) as good, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as bad:
        for name in dict.fromkeys([*good.namelist(), *new]):
            bad.writestr(name, new.get(name) or good.read(name))
    return target


def torch_file(content: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def test_the_traps_would_spring(tmp_path: Path) -> None:
    """Else the tests below would show nothing."""
    pickle.loads(pickle.dumps(Trap(tmp_path / "a")))
    torch.load(io.BytesIO(torch_file({"x": Trap(tmp_path / "b")})), weights_only=False)
    assert (tmp_path / "a").exists() and (tmp_path / "b").exists()


@pytest.mark.parametrize(
    "kind", ["bare pickle", "torch file", "among the tensors", "legacy torch file", "data", "other member"]
)
def test_a_crafted_pickle_in_a_models_zip_never_runs(kind: str, model_zip: Path, tmp_path: Path) -> None:
    trap = Trap(tmp_path / "sprung")
    buffer = io.BytesIO()
    torch.save({"action_net.weight": trap}, buffer, _use_new_zipfile_serialization=False)
    with zipfile.ZipFile(model_zip) as good:
        tensors = torch.load(io.BytesIO(good.read("policy.pth")), weights_only=True)
        data = json.loads(good.read("data"))
    import base64

    data["policy_kwargs"] = {":type:": "<class 'dict'>", ":serialized:": base64.b64encode(pickle.dumps(trap)).decode()}
    members: dict[str, dict[str, bytes]] = {
        "bare pickle": {"policy_pth": pickle.dumps(trap)},
        "torch file": {"policy_pth": torch_file(trap)},
        "among the tensors": {"policy_pth": torch_file({**tensors, "extra": trap})},
        "legacy torch file": {"policy_pth": buffer.getvalue()},
        "data": {"data": json.dumps(data).encode()},
        "other member": {"pytorch_variables_pth": torch_file(trap), "vecnormalize_pkl": pickle.dumps(trap)},
    }
    bad = changed_zip(model_zip, tmp_path / "bad.zip", **members[kind])
    if kind in ("data", "other member"):
        # What could be executed there is not looked at: the actor is read, and acts.
        assert np.isfinite(read_model(bad, Joining("x")).act(np.zeros(40, dtype=np.float32))).all()
    else:
        with pytest.raises(PolicyError, match=r"bad\.zip is not a model that stable-baselines3 saved"):
            join(bad, Joining("x"), tmp_path / "zoo")
    assert not (tmp_path / "sprung").exists() and not (tmp_path / "zoo").exists()


def test_a_normalisation_that_is_a_pickle_never_runs(model_zip: Path, tmp_path: Path) -> None:
    trap = Trap(tmp_path / "sprung")
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps(trap))
    np.savez(tmp_path / "objects.npz", mean=np.array([trap], dtype=object), var=np.ones(40))
    np.savez(tmp_path / "short.npz", mean=np.zeros(3), var=np.ones(3))
    for name, said in (
        ("vecnormalize.pkl", "a pickled VecNormalize is not read; write it with np.savez"),
        ("objects.npz", "does not hold a normalisation"),
        ("short.npz", r"observation\.mean is float32 \(3,\)"),
    ):
        with pytest.raises(PolicyError, match=said):
            read_model(model_zip, Joining("x", normalisation=tmp_path / name))
    assert not (tmp_path / "sprung").exists()


def test_what_a_zip_unpacks_to_is_bounded(model_zip: Path, tmp_path: Path, monkeypatch) -> None:
    """A bomb in a member, one inside the weights, and a view that claims to be larger than what is stored."""
    monkeypatch.setattr(sb3_actors, "LARGEST_WEIGHTS_BYTES", 2**20)
    monkeypatch.setattr(sb3_actors, "LARGEST_DATA_BYTES", 2**20)
    inner = io.BytesIO(torch_file({"action_net.weight": torch.zeros(2, 4)}))
    with zipfile.ZipFile(inner, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/7", b"\0" * 2**23)
    huge = torch.zeros(1).expand(2**12, 2**12)
    for members in (
        {"data": b" " * 2**23},
        {"policy_pth": b"\0" * 2**23},
        {"policy_pth": inner.getvalue()},
        {"policy_pth": torch_file({"action_net.weight": huge})},
    ):
        bad = changed_zip(model_zip, tmp_path / "bomb.zip", **members)
        assert bad.stat().st_size < 2**18
        with pytest.raises(PolicyError, match=r"larger than|more than"):
            read_model(bad, Joining("x"))


def test_a_zip_that_lies_about_a_members_size_is_bounded_too(model_zip: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sb3_actors, "LARGEST_DATA_BYTES", 2**20)
    bad = changed_zip(model_zip, tmp_path / "lie.zip", data=b" " * 2**23)
    content = bad.read_bytes().replace(struct.pack("<I", 2**23), struct.pack("<I", 100))
    bad.write_bytes(content)
    with pytest.raises(PolicyError):
        read_model(bad, Joining("x"))


@pytest.mark.parametrize("damage", ["nan", "shapes", "data", "deep json", "not a zip", "empty", "no member"])
def test_damaged_models_are_refused_in_one_line(damage: str, model_zip: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(model_zip) as good:
        tensors = torch.load(io.BytesIO(good.read("policy.pth")), weights_only=True)
    bad = tmp_path / "bad.zip"
    if damage == "nan":
        tensors["action_net.bias"][0] = float("nan")
        changed_zip(model_zip, bad, policy_pth=torch_file(tensors))
    elif damage == "shapes":
        tensors["action_net.weight"] = torch.zeros(2, 5)
        changed_zip(model_zip, bad, policy_pth=torch_file(tensors))
    elif damage in ("data", "deep json"):
        changed_zip(model_zip, bad, data=b"[]" if damage == "data" else b"[" * 200_000)
    elif damage == "no member":
        with zipfile.ZipFile(bad, "w") as archive:
            archive.writestr("../../data", "{}")
    else:
        bad.write_bytes(b"PK\x03\x04 and no more" if damage == "not a zip" else b"")
    with pytest.raises(PolicyError, match=r"bad\.zip") as caught:
        read_model(bad, Joining("x"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["../up", "a/b", "/abs", "..", ".hidden", "", "a\\b", "x" * 65, "new\nline", "a\x1b[2J"]
)
def test_names_are_no_paths(name: str, model_zip: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="name is"):
        join(model_zip, Joining(name), tmp_path / "zoo")
    assert [path.name for path in tmp_path.iterdir()] == []
    with pytest.raises((PolicyError, UnknownName)):
        find_policy(name if name else "..")


def test_a_card_says_nothing_to_a_terminal_but_text(copy: Path) -> None:
    card = json.loads((copy / CARD_FILE).read_text())
    for field, value in (
        ("description", "\x1b]0;owned\x07"),
        ("name", "../direct"),
        ("statistics", {"a\x1b[2J": 1.0}),
        ("statistics", {"a": float("nan")}),
        ("split", "both"),
        ("steps", -1),
        ("network", {"layers": [40, 10**9, 2]}),
        ("network", {"layers": [40] * 99}),
    ):
        (copy / CARD_FILE).write_text(json.dumps({**card, field: value}))
        with pytest.raises(PolicyError, match=rf"card\.json: {field}") as caught:
            load_policy(copy)
        assert "\x1b" not in str(caught.value)


def test_policies_files_are_bounded(copy: Path, monkeypatch) -> None:
    """Also a safetensors header that claims to be larger than the file."""
    content = (copy / WEIGHTS_FILE).read_bytes()
    forged = struct.pack("<Q", 2**62) + content[8:]
    (copy / WEIGHTS_FILE).write_bytes(forged)
    card = (copy / CARD_FILE).read_text()
    digest = json.loads(card)["sha256"]
    (copy / CARD_FILE).write_text(card.replace(digest, hashlib.sha256(forged).hexdigest()))
    with pytest.raises(PolicyError, match="not a safetensors file"):
        load_policy(copy)
    monkeypatch.setattr(zoo, "LARGEST_WEIGHTS_BYTES", 2**10)
    with pytest.raises(PolicyError, match="is larger than"):
        load_policy(copy)
    monkeypatch.setattr(zoo, "LARGEST_CARD_BYTES", 100)
    with pytest.raises(PolicyError, match=r"card\.json is larger than"):
        load_policy(copy)


def test_tensors_that_the_card_does_not_describe_are_refused(copy: Path) -> None:
    tensors = dict(load_tensors((copy / WEIGHTS_FILE).read_bytes()))
    tensors["extra"] = np.zeros(3, dtype=np.float32)
    content = save_tensors(tensors)
    (copy / WEIGHTS_FILE).write_bytes(content)
    card = (copy / CARD_FILE).read_text()
    digest = json.loads(card)["sha256"]
    (copy / CARD_FILE).write_text(card.replace(digest, hashlib.sha256(content).hexdigest()))
    with pytest.raises(PolicyError, match="extra is no tensor of the network"):
        load_policy(copy)


def test_a_policys_folder_has_its_name(copy: Path) -> None:
    copy.rename(copy.with_name("side"))
    with pytest.raises(PolicyError, match="its card is that of 'direct', a policy's folder must have its name"):
        load_zoo(copy.parent)
