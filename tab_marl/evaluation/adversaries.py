"""Which adversaries a table plays, by name; those for development and those of the final table are not mixed unasked."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from tab_marl.agents.adversaries import AdversaryPolicy, ScriptedAdversary
from tab_marl.agents.measures.rollouts import zoo_rollouts
from tab_marl.agents.planners import ROLLOUTS_PER_POLICY, Rollouts
from tab_marl.agents.policies.cards import SPLITS, Split
from tab_marl.agents.policies.zoo import SHIPPED, ZooPolicy, all_policies, find_policy, load_policy, load_zoo
from tab_marl.evaluation.errors import UserError, require_known

SCRIPTED = "scripted"
"""The route follower that nobody trained: may be asked for beside the zoo's policies."""
ALL = "all"
GROUPS = (*SPLITS, ALL)
"""Stand for the shipped policies of a split, or of both."""


def opponent(name: str) -> AdversaryPolicy:
    """A policy of the zoo by name, `scripted`, or the policy in a folder. Raises UnknownName or PolicyError.

    Every call gives one with a memory of its own: a planner rolls out the very policy that it plays against.
    """
    return ScriptedAdversary() if name == SCRIPTED else _found(name).another()


@lru_cache(maxsize=64)
def _found(name: str) -> ZooPolicy:
    return find_policy(name)


@lru_cache(maxsize=4)
def zoo_names(split: Split | None = None) -> tuple[str, ...]:
    """Names of the shipped policies of a split (None: of both), sorted."""
    return tuple(policy.name for policy in load_zoo(split=split))


def population(names: Sequence[str]) -> Rollouts:
    """What population-POMCP knows: trajectories of the very adversaries that a table plays."""

    def rollouts(task, rng):  # type: ignore[no-untyped-def]
        return zoo_rollouts([opponent(name) for name in names], task, rng, ROLLOUTS_PER_POLICY)

    return rollouts


def precedents(played: str) -> Rollouts:
    """What TAB-POMCP+precedents is shown: trajectories of the shipped development policies, never of the one that it plays."""
    name = opponent(played).name
    return population([other for other in zoo_names("development") if other != name])


def digest(policy: ZooPolicy) -> str:
    """Of what decides how a policy plays: its weights, and what its card says of the network and of the routes it is shown."""
    said = policy.card.model_dump_json(include={"name", "sha256", "network", "style"})
    return hashlib.blake2b(said.encode(), digest_size=8).hexdigest()


def resolve_opponents(asked: Sequence[str], mix_splits: bool = False) -> dict[str, str]:
    """What to call each opponent in a job -> digest of what it is; the shipped policies of the final split if none is asked.

    `asked`: names of policies that ship or are the user's, folders, "scripted", or a group ("development", "final",
    "all"). Shipped policies (whose files the code's fingerprint covers) go by name, others by the full path of their
    folder. Raises UserError, also if both splits are among them and `mix_splits` does not say that this is meant; UnknownName or
    PolicyError.
    """
    found: dict[str, str] = {}
    splits: dict[Split, list[str]] = {"development": [], "final": []}

    def take(name: str, known_by: str, policy: ZooPolicy) -> None:
        if name not in found:
            splits[policy.split].append(policy.name)
        found[name] = known_by

    for name in asked or ("final",):
        if os.sep in name:
            policy = load_policy(name)
            take(str(Path(name).resolve()), digest(policy), policy)
            continue
        known = {policy.name: (policy, path) for policy, path in all_policies()}
        if Path(name).is_dir() and name not in known and name not in GROUPS:
            policy = load_policy(name)
            take(str(Path(name).resolve()), digest(policy), policy)
            continue
        (right,) = require_known("adversary", (name,), (*known, SCRIPTED, *GROUPS))
        if right == SCRIPTED:
            found[SCRIPTED] = ""
        elif right in GROUPS:
            members = [p for p in load_zoo() if right in (ALL, p.split)]
            if not members:
                raise UserError(f"the zoo holds no adversary of the split {right!r}: name others with --adversaries")
            for policy in members:
                take(policy.name, "", policy)
        else:
            policy, path = known[right]
            if path.parent == SHIPPED:
                take(right, "", policy)
            else:
                take(str(path.resolve()), digest(policy), policy)
    if all(splits.values()) and not mix_splits:
        raise UserError(
            f"the adversaries mix policies for development ({', '.join(splits['development'])}) and for the final table "
            f"({', '.join(splits['final'])}): a table is of one split; leave one out, or say --mix-splits"
        )
    return found
