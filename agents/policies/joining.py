"""How another researcher's stable-baselines3 model joins a zoo: read safely, measured, and only then written."""

from __future__ import annotations

import dataclasses
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from tab_marl.agents.measures.measuring import MEASURED, OnPlayed, Sheet, below_claim, claimed, measured_policy
from tab_marl.agents.policies.actor import Actor, ActorError
from tab_marl.agents.policies.cards import PolicyCard, Split, is_name
from tab_marl.agents.policies.sb3_actors import normalised, read_zip
from tab_marl.agents.policies.zoo import CONTROLS, SHIPPED, PolicyError, ZooPolicy, load_zoo, save_policy, user_zoo
from tab_marl.envs.adversary_observation import LAYOUT_VERSION, OBSERVED
from tab_marl.envs.styles import Style
from tab_marl.mission.compositions import SAMPLED
from tab_marl.mission.tasks import MISSION_IDS
from tab_marl.world.scenario import UnknownName

EPISODES = 40
"""Per mission type, on which a policy that joins is measured."""
COMPARED = 75
LARGEST_STATISTICS_BYTES = 2**20


class BelowClaim(PolicyError):
    """A policy that does not complete what it claims."""


@dataclass(frozen=True)
class Joining:
    """What is said about a model that is to join."""

    name: str
    style: str = "direct"
    """Name of the style under which its environment showed it routes; `Adversary-v0`'s own is direct."""
    missions: tuple[str, ...] = MISSION_IDS
    """Mission types that it claims."""
    split: Split = "development"
    algorithm: str = ""
    """Default: what the file says."""
    author: str = ""
    description: str = ""
    command: str = ""
    """What trains it again."""
    normalisation: Path | None = None
    """``.npz`` of VecNormalize's statistics: arrays ``mean`` and ``var`` of 40 numbers, maybe ``clip`` and ``epsilon``."""


def read_model(file: Path | str, joining: Joining) -> ZooPolicy:
    """The model in a zip that ``model.save`` wrote, as a policy without measured figures; nothing in the file is executed.

    Raises PolicyError: unusable name or file, an actor for something else; UnknownName for the style or a mission type.
    """
    if not is_name(joining.name):
        raise PolicyError(
            f"name is {joining.name!r}, must be up to 64 letters, digits, dots, dashes and underscores, no dot first"
        )
    for mission in joining.missions:
        if mission not in MEASURED:
            raise UnknownName("mission type", mission, MEASURED)
    if not joining.missions:
        raise PolicyError("missions is empty: a policy claims at least one mission type")
    try:
        saved = read_zip(file)
        actor = saved.actor if joining.normalisation is None else _behind(saved.actor, joining.normalisation)
    except ActorError as error:
        raise PolicyError(str(error)) from None
    if actor.network.layers[0] != OBSERVED:
        raise PolicyError(
            f"{file}: it was trained on {actor.network.layers[0]} observed numbers, the adversary observes {OBSERVED}: "
            "train on tab_marl/Adversary-v0 or tab_marl/BatchedAdversary-v0"
        )
    try:
        card = PolicyCard(
            name=joining.name,
            description=joining.description,
            author=joining.author,
            algorithm=joining.algorithm or saved.algorithm,
            layout_version=LAYOUT_VERSION,
            network=actor.network,
            split=joining.split,
            style=Style.preset(joining.style),
            missions=joining.missions,
            steps=saved.steps,
            command=joining.command,
            sha256="0" * 64,
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise PolicyError(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}") from None
    return ZooPolicy(card, actor, saved.log_std)


def join(
    file: Path | str,
    joining: Joining,
    zoo: Path | None = None,
    anyway: bool = False,
    episodes: int = EPISODES,
    on_played: OnPlayed | None = None,
) -> tuple[ZooPolicy, Path]:
    """Read, measure on held-out tasks and write a model to a zoo (default: the user's); the policy and its folder.

    The folder appears whole or not at all. Raises PolicyError for a name that is taken and as `read_model` does; BelowClaim,
    unless `anyway` (then the card says so), if it completes less than 90 % of a mission type that it claims.
    """
    policy = read_model(file, joining)
    root = user_zoo() if zoo is None else Path(zoo)
    for taken in (SHIPPED / policy.name, root / policy.name):
        if taken.exists():
            raise PolicyError(f"there is a policy named {policy.name} already ({taken}): choose another --name")
    sheet = Sheet.draw(episodes * len(MISSION_IDS), episodes, min(COMPARED, episodes * len(MISSION_IDS)))
    policy, below = assessed(policy, joining.missions, sheet, on_played)
    if below and not anyway:
        raise BelowClaim(
            f"{policy.name} was not added: {'; '.join(below)}; claim less with --missions, give --normalisation if it was "
            "trained under VecNormalize, the --style whose routes it was shown, or add it --anyway"
        )
    card = policy.card.model_copy(update={"exceptions": tuple(below)})
    policy = dataclasses.replace(policy, card=card)
    save_policy(policy, root / policy.name)
    return policy, root / policy.name


def assessed(
    policy: ZooPolicy, wanted: Sequence[str], sheet: Sheet, on_played: OnPlayed | None = None
) -> tuple[ZooPolicy, list[str]]:
    """The policy with what was measured on its card, and what it falls short of.

    It claims what was wanted, and sampled compositions where it completes enough of them.
    """
    controls = [sheet.behaviour(control) for control in (load_zoo(CONTROLS) if CONTROLS.is_dir() else [])]
    measured, _ = measured_policy(policy, sheet, controls, on_played)
    records = measured.card.success
    extra = (SAMPLED,) if SAMPLED in claimed(records) and SAMPLED not in wanted else ()
    card = measured.card.model_copy(update={"missions": (*wanted, *extra)})
    return dataclasses.replace(measured, card=card), below_claim(records, wanted)


def _behind(actor: Actor, file: Path) -> Actor:
    """The actor behind VecNormalize's statistics in an .npz. Raises ActorError."""
    recipe = (
        "np.savez('statistics.npz', mean=env.obs_rms.mean, var=env.obs_rms.var, clip=env.clip_obs, epsilon=env.epsilon)"
    )
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(info.file_size for info in archive.infolist()) > LARGEST_STATISTICS_BYTES:
                raise ActorError(f"{file} is larger than statistics of an observation are")
        # Arrays alone: numpy refuses to unpickle anything.
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: np.asarray(found[name], dtype=np.float64) for name in found.files}
        mean, variance = arrays["mean"], arrays["var"]
        clip, epsilon = float(arrays.get("clip", np.float64(10.0))), float(arrays.get("epsilon", np.float64(1e-8)))
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        said = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise ActorError(
            f"{file} does not hold a normalisation ({said}): a pickled VecNormalize is not read; write it with {recipe}"
        ) from None
    return normalised(actor, mean, variance, clip, epsilon)
